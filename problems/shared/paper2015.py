"""The linear model of Ye, Wang, Chen, IJRES 3(7), 2015, equations (3) to (16), derived anew.

The paper linearises valve and chambers about rest at mid stroke and gets a transfer function from spool travel to
speed. Two steps of it do not hold, and are mended here:

- It sets the deviation of the second chamber's pressure to zero (``P_b = 0``). That pressure moves; without the
  assumption the transfer function is of third order with a zero (`third_order`). What is needed is ``K_cb = m K_ca``:
  then P_b drops out exactly, and a pole and the zero, both at ``-K_ca kappa R T_s / V_0a``, cancel (`second_order`).
  It holds for a rodless drive at mid stroke with a symmetric valve at its null, and without leakage.
- Equation (15) drops a constant. At constant speed viscous friction k_v needs a pressure difference, that leaks through
  K_ca, and the valve must make up for it: the constant term is ``w0² + K_ca k_v kappa R T_s / (V_0a M_L)``
  (`constant_term`), not w0². For the set below that is 86.34 instead of 72.45: without it the gain at low frequency
  comes out 19 % too high.

Sign: K_cb is positive here, ``M_b = K_mb x_v + K_cb p_b``; the paper carries it with the other sign.
"""

from dataclasses import dataclass
from math import pi, sqrt

import numpy as np

import pneuopt as po
from problems.shared.arrays import Array

PolynomialPair = tuple[Array, Array]
KAPPA, R = 1.4, 287.05
PRINTED_COEFFICIENTS = (1270.12, 17.5, 86.34)


@dataclass(frozen=True)
class OperatingPoint:
    """Rest at mid stroke, in the paper's symbols; the default is the set that gives the paper's eq. (16).

    Parameters
    ----------
    K_ma, K_mb : float
        Flow gains of the two valve edges, ``dM/dx_v`` [kg/(s m)].
    K_ca, K_cb : float
        Flow-pressure coefficients, ``-dM_a/dp_a`` and ``+dM_b/dp_b`` [kg/(s Pa)].
    A_a : float
        Piston area of chamber a [m²].
    n, m : float
        Ratios of area ``A_b / A_a`` and volume ``V_0b / V_0a`` [-].
    p_ai : float
        Pressure of chamber a at rest, absolute [Pa]; chamber b has p_ai / n.
    V_0a : float
        Volume of chamber a at mid stroke, with its dead volume [m³].
    T_s : float
        Temperature of the supply [K].
    M_L, k_v : float
        Mass [kg] and viscous friction [N s/m].
    """

    K_ma: float = 12.385632316574373
    K_mb: float = 12.385632316574373
    K_ca: float = 2.6593213616827916e-09
    K_cb: float = 2.6593213616827916e-09
    A_a: float = 4.908738521234052e-4
    n: float = 1.0
    m: float = 1.0
    p_ai: float = 4.84457876e5
    V_0a: float = 3.75947805e-4
    T_s: float = 293.15
    M_L: float = 12.0
    k_v: float = 200.0


def operating_point(drive: po.PneumaticDrive, parameters: po.ParameterSet, half_travel: float) -> OperatingPoint:
    """The paper's symbols read off a nonlinear drive at rest, by AD: equations (3), (4) and (9) to (11) backwards.

    Parameters
    ----------
    drive : PneumaticDrive
        Rodless, with viscous friction and a spool without lag, of which alone the paper speaks.
    parameters : ParameterSet
    half_travel : float
        The spool's way from its centre to full opening [m].

    Returns
    -------
    OperatingPoint

    Raises
    ------
    InputError
        If it is another drive.

    Examples
    --------
    >>> point = operating_point(*po.catalog.r25(), half_travel=1e-3)
    >>> round(point.K_ma, 4), round(point.K_ca * 1e9, 4)
    (12.3856, 2.6593)
    """
    p = {n: parameters.value(n) for n in drive.parameters}
    suited = isinstance(drive.friction, po.Viscous) and drive.valve.spool is po.Spool.RIGID and p["cylinder.rod"] == 0
    if not (suited and "chamber.exponent" in p):
        raise po.InputError(
            "the paper's drive is rodless, with Viscous() friction, Spool.RIGID and Polytropic() chambers; this is not"
        )
    rest = drive.rest(parameters)
    linear = drive.system().linearise(np.array(list(rest.states.values())), rest.inputs, parameters)
    a, b = (linear.states.index(f"pressure_{side}") for side in "ab")
    area, y = pi / 4 * p["cylinder.bore"] ** 2, rest.states["position"]
    volume_a = p["cylinder.dead_volume_a"] + area * y
    volume_b = p["cylinder.dead_volume_b"] + area * (p["cylinder.stroke"] - y)
    heat = p["chamber.exponent"] * p["gas.constant"] * p["ambient.temperature"]
    per_metre = p["valve.span"] / half_travel
    return OperatingPoint(
        K_ma=float(linear.B[a, 0]) * per_metre * volume_a / heat,
        K_mb=-float(linear.B[b, 0]) * per_metre * volume_b / heat,
        K_ca=-float(linear.A[a, a]) * volume_a / heat,
        K_cb=-float(linear.A[b, b]) * volume_b / heat,
        A_a=area,
        m=volume_b / volume_a,
        p_ai=rest.states["pressure_a"],
        V_0a=volume_a,
        T_s=p["ambient.temperature"],
        M_L=p["load.mass"],
        k_v=p["friction.viscous"],
    )


def spool_gain(point: OperatingPoint) -> float:
    """b0 of equation (15), ``(K_ma + n/m K_mb) R T_s / ((1 + n/m) p_ai A_a)`` [1/s].

    Examples
    --------
    >>> round(spool_gain(OperatingPoint()), 2)
    4382.68
    """
    share = point.n / point.m
    return (point.K_ma + share * point.K_mb) * R * point.T_s / ((1 + share) * point.p_ai * point.A_a)


def natural_frequency(point: OperatingPoint) -> float:
    """w0 of equation (15), ``sqrt((1 + n/m) kappa p_ai A_a² / (V_0a M_L))`` [rad/s]: the mass on two air springs.

    Examples
    --------
    >>> round(natural_frequency(OperatingPoint()), 3)
    8.512
    """
    share = point.n / point.m
    return sqrt((1 + share) * KAPPA * point.p_ai * point.A_a**2 / (point.V_0a * point.M_L))


def damping(point: OperatingPoint) -> float:
    """zeta0 of equation (15) [-]: leakage and viscous friction, ``2 zeta0 w0 = leak_rate + k_v / M_L``.

    Examples
    --------
    >>> point = OperatingPoint()
    >>> round(2 * damping(point) * natural_frequency(point), 4)
    17.5
    """
    p, share = point, 1 + point.n / point.m
    leak = p.K_ca * R * p.T_s / (2 * p.A_a * p.p_ai) * sqrt(KAPPA * p.p_ai * p.M_L / (share * p.V_0a))
    return leak + p.k_v / (2 * p.A_a) * sqrt(p.V_0a / (share * KAPPA * p.p_ai * p.M_L))


def leak_rate(point: OperatingPoint) -> float:
    """The pole and zero that cancel when ``K_cb = m K_ca``, ``K_ca kappa R T_s / V_0a`` [1/s].

    Examples
    --------
    >>> round(leak_rate(OperatingPoint()), 5)
    0.83333
    """
    return point.K_ca * KAPPA * R * point.T_s / point.V_0a


def constant_term(point: OperatingPoint) -> float:
    """The denominator's constant, ``w0² + K_ca k_v kappa R T_s / (V_0a M_L)`` [1/s²]; (15) drops the second part.

    Examples
    --------
    >>> point = OperatingPoint()
    >>> round(constant_term(point), 2), round(natural_frequency(point) ** 2, 2)
    (86.34, 72.45)
    """
    return natural_frequency(point) ** 2 + leak_rate(point) * point.k_v / point.M_L


def second_order(point: OperatingPoint, dropped_constant: bool = False) -> PolynomialPair:
    """Speed over spool travel, equation (15) times s, where ``K_cb = m K_ca``.

    Parameters
    ----------
    point : OperatingPoint
    dropped_constant : bool
        As printed: leave the second part of `constant_term` out.

    Returns
    -------
    numerator, denominator : ndarray
        Highest power first; ``b0 w0² / (s² + 2 zeta0 w0 s + constant)`` [1/s].

    Examples
    --------
    >>> num, den = second_order(OperatingPoint())
    >>> K_d, K_s = 2e-4, 20.0
    >>> [round(float(c), 2) for c in (*(num * K_d * K_s), *den)]
    [1270.12, 1.0, 17.5, 86.34]
    """
    w0 = natural_frequency(point)
    constant = w0**2 if dropped_constant else constant_term(point)
    return np.array([spool_gain(point) * w0**2]), np.array([1.0, 2 * damping(point) * w0, constant])


def third_order(point: OperatingPoint) -> PolynomialPair:
    """Speed over spool travel from equations (3), (4), (9) to (11) alone: what (12) and (13) give with P_b kept.

    With ``c = kappa R T_s / V_0a``, ``a = c K_ca``, ``b = c K_cb / m``, ``g = kappa p_ai A_a / V_0a``, ``r = n / m``::

        A_a c (K_ma (s + b) + r K_mb (s + a)) / ((M_L s + k_v)(s + a)(s + b) + A_a g ((s + b) + r (s + a)))

    Returns
    -------
    numerator, denominator : ndarray
        Highest power first, the denominator's first coefficient 1.

    Examples
    --------
    >>> num, den = third_order(OperatingPoint(n=0.9, K_cb=1e-9))
    >>> len(num), len(den)
    (2, 4)
    """
    q = point
    c, g, r = KAPPA * R * q.T_s / q.V_0a, KAPPA * q.p_ai * q.A_a / q.V_0a, q.n / q.m
    lag_a, lag_b = np.array([1.0, c * q.K_ca]), np.array([1.0, c * q.K_cb / q.m])
    top = q.A_a * c * (q.K_ma * lag_b + r * q.K_mb * lag_a)
    bottom: Array = np.convolve([q.M_L, q.k_v], np.convolve(lag_a, lag_b))
    bottom[2:] += q.A_a * g * (lag_b + r * lag_a)
    return top / q.M_L, bottom / q.M_L


def state_space(point: OperatingPoint) -> tuple[Array, Array, Array]:
    """Equations (3), (4), (9), (10), (11) as ``dx/dt = A x + B x_v``, ``v = C x``; x is speed, p_a, p_b (deviations).

    Returns
    -------
    A : ndarray, shape (3, 3)
    B : ndarray, shape (3, 1)
    C : ndarray, shape (1, 3)

    Examples
    --------
    >>> A, B, C = state_space(OperatingPoint())
    >>> sorted(round(float(e.real), 4) for e in np.linalg.eigvals(A))
    [-8.75, -8.75, -0.8333]
    """
    q = point
    c, g = KAPPA * R * q.T_s / q.V_0a, KAPPA * q.p_ai * q.A_a / q.V_0a
    A = np.array(
        [
            [-q.k_v / q.M_L, q.A_a / q.M_L, -q.n * q.A_a / q.M_L],
            [-g, -c * q.K_ca, 0.0],
            [g / q.m, 0.0, -c * q.K_cb / q.m],
        ]
    )
    return A, np.array([[0.0], [c * q.K_ma], [-c * q.K_mb / q.m]]), np.array([[1.0, 0.0, 0.0]])


def paper_plant(loop_gain: float = 1.0) -> tuple[po.System, po.ParameterSet]:
    """Equation (16) as printed: ``1270.12 loop_gain / (s² + 17.5 s + 86.34)``, valve voltage to the speed's voltage.

    The speed is in volts: the figures' axis is, and 14.7 (m/s)/V would be no speed of a cylinder; the transducer's gain
    is folded in.

    Parameters
    ----------
    loop_gain : float
        Factor on the gain; 0.5 is what the paper's "friction compensation" amounts to.

    Returns
    -------
    system : System
        A `SecondOrder`, input valve_voltage [V], output speed [V].
    parameters : ParameterSet

    Examples
    --------
    >>> system, parameters = paper_plant()
    >>> round(parameters.value("plant.gain"), 4), round(parameters.value("plant.damping"), 4)
    (14.7107, 0.9417)
    """
    gain, rate, constant = PRINTED_COEFFICIENTS
    system = po.SecondOrder(output=po.Quantity("speed", "V")).system()
    values = {
        "plant.gain": loop_gain * gain / constant,
        "plant.natural_frequency": sqrt(constant),
        "plant.damping": rate / (2 * sqrt(constant)),
    }
    source = "Ye, Wang, Chen, IJRES 3(7), 2015, eq. (16)"
    printed = {n: po.Parameter(v, system.parameters[n].unit, source=source) for n, v in values.items()}
    return system, po.ParameterSet(printed)
