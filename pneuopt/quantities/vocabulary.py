"""The units that are known: a short list of our own loads fast, and keeps surprises out, "pt" as a pint, say."""

UNIT_DEFINITIONS = """
nano- = 1e-9 = n-
micro- = 1e-6 = µ- = μ- = u-
milli- = 1e-3 = m-
centi- = 1e-2 = c-
deci- = 1e-1 = d-
hecto- = 1e2 = h-
kilo- = 1e3 = k-
mega- = 1e6 = M-
giga- = 1e9 = G-
meter = [length] = m = metre
kilogram = [mass] = kg
second = [time] = s = sec
ampere = [current] = A = amp
kelvin = [temperature] = K
radian = [angle] = rad
cycle = [cycle]
percent = 0.01 = %
permille = 0.001 = ‰
ppm = 1e-6
count = 1 = cnt
gram = 1e-3 kilogram = g
tonne = 1000 kilogram = t
pound = 0.45359237 kilogram = lb
minute = 60 second = min
hour = 3600 second = h
day = 86400 second = d
inch = 0.0254 meter = in
foot = 0.3048 meter = ft
degree_Celsius = kelvin; offset: 273.15 = °C = degC = celsius
degree = 0.017453292519943295769 radian = deg = °
revolution = 6.283185307179586477 radian = rev
rpm = revolution / minute
hertz = cycle / second = Hz
newton = kilogram * meter / second ** 2 = N
kilogram_force = 9.80665 newton = kgf = kp
pound_force = 4.4482216152605 newton = lbf
pascal = newton / meter ** 2 = Pa
bar = 1e5 pascal
psi = 6894.757293168361 pascal
standard_atmosphere = 101325 pascal = atm
joule = newton * meter = J
watt = joule / second = W
volt = watt / ampere = V
coulomb = ampere * second = C
ohm = volt / ampere = Ω
liter = 1e-3 meter ** 3 = l = L = litre
newton_meter = newton * meter = Nm
newton_second = newton * second = Ns
volt_second = volt * second = Vs
"""
"""pint's definitions."""

COMMON_UNITS = """
m mm um cm km in s ms us min h day kg g t N kN Nm V mV A mA K degC Hz kHz rad deg rad/s rpm m/s mm/s m/s^2 m^2 m^3 mm^2
cm^2 cm^3 l N*s/m V*s/m 1/s m^3/(s*Pa) % count kg*m^2 N*m rev N*m*s/rad newton volt meter Pa kPa MPa bar mbar psi
Pa(a) Pa(g) kPa(a) kPa(g) MPa(a) MPa(g) bar(a) bar(g) mbar(a) mbar(g) psi(a) psi(g)
"""
"""The units that a message may suggest."""
