"""Each maker's block by its documented formula, fed with nothing but the text of a sheet."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

ROW = re.compile(r"^  (\S.*?)  +(\S.*?)(?:  |$)")


def read_settings(text: str, heading: str = "Settings") -> dict[str, str]:
    """The rows below a heading of a sheet, name to value."""
    lines = text.split("\n")
    begin = next(k for k, line in enumerate(lines) if line.startswith(heading))
    found = {}
    for line in lines[begin + 2 :]:
        match = ROW.match(line)
        if match is None:
            break
        found[match[1]] = match[2]
    return found


class Emulation(Protocol):
    """A block in automatic; `stopped` is what stands on the wire while it is not."""

    def step(self, setpoint: float, measured: float, added: float = 0.0) -> float: ...

    @property
    def stopped(self) -> list[float]: ...


def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


@dataclass
class Siemens:
    """``y = Gain ((b w - x) + 1/(Ti s) (w - x) + Td s/(a Td s + 1) (c w - x)) + Disturbance`` in %."""

    rows: Mapping[str, str]
    integral: float = 0.0
    derivative: float = 0.0
    before: float = 0.0

    def __getitem__(self, name: str) -> float:
        return float(self.rows[name])

    def start(self, setpoint: float, measured: float) -> None:
        """Smooth (IntegralResetMode 0): it begins with the output 0."""
        assert self.rows["IntegralResetMode"] == "0"
        b, c = (self[f"Retain.CtrlParams.{n}"] for n in ("PWeighting", "DWeighting"))
        self.integral = -self._gain() * (b * setpoint - measured) if self["Retain.CtrlParams.Ti"] > 0 else 0.0
        self.before = c * setpoint - measured

    def _gain(self) -> float:
        return self["Retain.CtrlParams.Gain"] * (-1 if self.rows["Config.InvertControl"] == "TRUE" else 1)

    def step(self, setpoint: float, measured: float, added: float = 0.0) -> float:
        assert self.rows["Config.InputPerOn"] == "FALSE"
        assert self["CycleTime.Value"] == self["Retain.CtrlParams.Cycle"]
        in_range = self["Config.InputLowerLimit"] <= measured <= self["Config.InputUpperLimit"]
        if not in_range and self.rows["ActivateRecoverMode"] == "FALSE":
            return self.wire(0.0)  # the recover mode would stay in automatic
        w = _clip(setpoint, self["Config.SetpointLowerLimit"], self["Config.SetpointUpperLimit"])
        Ti, Td, a = (self[f"Retain.CtrlParams.{n}"] for n in ("Ti", "Td", "TdFiltRatio"))
        h, gain, e = self["Retain.CtrlParams.Cycle"], self._gain(), w - measured
        b, c = (self[f"Retain.CtrlParams.{n}"] for n in ("PWeighting", "DWeighting"))
        self.integral += gain * h / Ti * e if Ti > 0 else 0.0
        now = c * w - measured
        lag = a * Td
        self.derivative = (lag * self.derivative + gain * Td * (now - self.before)) / (lag + h)
        self.before = now
        y = gain * (b * w - measured) + self.integral + self.derivative + self["Disturbance"] + added
        return self.wire(_clip(y, self["Config.OutputLowerLimit"], self["Config.OutputUpperLimit"]))

    def wire(self, percent: float) -> float:
        return self["Behind the block: offset"] + self["Behind the block: factor"] * percent

    @property
    def stopped(self) -> list[float]:
        assert (self.rows["SetSubstituteOutput"], self.rows["RunModeByStartup"]) == ("TRUE", "FALSE")
        return [self.wire(0.0), self.wire(self["SubstituteOutput"])]


@dataclass
class RockwellPID:
    """``CV = KP E + KI int E dt + KD dE/dt + BIAS``, E in % of MAXS - MINS, CV in % of MAXCV - MINCV."""

    rows: Mapping[str, str]
    integral: float = 0.0
    before: float = 0.0

    def __getitem__(self, name: str) -> float:
        return float(self.rows[f"PID .{name}"])

    def start(self, setpoint: float, measured: float) -> None:
        """From software manual: without an integral NOBC keeps BIAS, with one it is calculated back."""
        assert self["PE"] == 0
        E = self._percent(setpoint) - self._percent(measured)
        E = -E if self["CA"] else E
        if self["KI"]:
            self.integral = self["SO"] - self["KP"] * E - self["BIAS"]
        else:
            assert self["NOBC"] == 1
        self.before = self._differentiated(setpoint, measured)

    def _percent(self, value: float) -> float:
        scaled = self["MINS"] + (value - self["MINI"]) / (self["MAXI"] - self["MINI"]) * (self["MAXS"] - self["MINS"])
        return 100 * scaled / (self["MAXS"] - self["MINS"])

    def _differentiated(self, setpoint: float, measured: float) -> float:
        value = (self._percent(setpoint) if self["DOE"] else 0.0) - self._percent(measured)
        return -value if self["CA"] else value

    def step(self, setpoint: float, measured: float, added: float = 0.0) -> float:
        assert self["MINS"] <= setpoint <= self["MAXS"]
        E = self._percent(setpoint) - self._percent(measured)
        E = -E if self["CA"] else E
        now, h = self._differentiated(setpoint, measured), self["UPD"]
        rate = (now - self.before) / h
        self.before = now
        self.integral += self["KI"] * h * E
        CV = self["KP"] * E + self.integral + self["KD"] * rate + self["BIAS"] + added
        return self.wire(_clip(CV, self["MINO"], self["MAXO"]))

    def wire(self, percent: float) -> float:
        return self["MINCV"] + percent / 100 * (self["MAXCV"] - self["MINCV"])

    @property
    def stopped(self) -> list[float]:
        assert self["SWM"] == 1
        return [self.wire(self["SO"])]


@dataclass
class RockwellPIDE:
    """The velocity form: ``CV = CV_ + KP dE + KI E dt + KD d(dE)/dt``, times in minutes."""

    rows: Mapping[str, str]
    CV: float = 0.0
    errors: list[float] = field(default_factory=list)

    def __getitem__(self, name: str) -> float:
        return float(self.rows[f"PIDE {name}"])

    def _is(self, name: str) -> bool:
        return self.rows[f"PIDE {name}"] == "true"

    def start(self, setpoint: float, measured: float) -> None:
        assert (self._is("ProgProgReq"), self._is("ManualAfterInit"), self._is("DependIndepend")) == (True, True, False)
        assert is_close(self.wire(self["CVProg"]), self["CVInitValue"], 46.0)
        self.CV = self["CVProg"]
        self.P, self.D = self._proportional(setpoint, measured), self._derivative(setpoint, measured)
        self.rate = 0.0

    def _percent(self, value: float) -> float:
        return 100 * value / (self["PVEUMax"] - self["PVEUMin"])

    def _signal(self, setpoint: float, measured: float, of_pv: bool) -> float:
        value = (0.0 if of_pv else self._percent(setpoint)) - self._percent(measured)
        return -value if self._is("ControlAction") else value

    def _proportional(self, setpoint: float, measured: float) -> float:
        return self._signal(setpoint, measured, self._is("PVEProportional"))

    def _derivative(self, setpoint: float, measured: float) -> float:
        return self._signal(setpoint, measured, self._is("PVEDerivative"))

    def step(self, setpoint: float, measured: float, added: float = 0.0) -> float:
        assert added == 0
        assert self["SPLLimit"] <= setpoint <= self["SPHLimit"]
        h = float(self.rows["PIDE period of its task"])
        P, D = self._proportional(setpoint, measured), self._derivative(setpoint, measured)
        E, rate = self._signal(setpoint, measured, False), (D - self.D) / h
        change = self["PGain"] * (P - self.P) + self["IGain"] / 60 * h * E + self["DGain"] * 60 * (rate - self.rate)
        self.P, self.D, self.rate = P, D, rate
        self.CV = _clip(self.CV + change + self["FF"], self["CVLLimit"], self["CVHLimit"])
        return self.wire(self.CV)

    def wire(self, percent: float) -> float:
        return self["CVEUMin"] + percent / 100 * (self["CVEUMax"] - self["CVEUMin"])

    @property
    def stopped(self) -> list[float]:
        return [self["CVInitValue"], self.wire(self["CVProg"])]


@dataclass
class Beckhoff:
    """``fKp (1 + 1/(tTn s) + tTv s/(1 + tTd s))``; T#0ms switches a term off."""

    rows: Mapping[str, str]
    integral: float = 0.0
    derivative: float = 0.0
    before: float = 0.0

    def __getitem__(self, name: str) -> float:
        return float(self.rows[name])

    def _time(self, name: str) -> float:
        match = re.fullmatch(r"T#(\d+)ms", self.rows[name])
        assert match
        return int(match[1]) / 1000

    def start(self, setpoint: float, measured: float) -> None:
        """From manual, whose value the integral takes over."""
        e = setpoint * (self.rows["bPInTheFeedbackPath"] == "FALSE") - measured
        self.integral = self["fManSyncValue"] - self["fKp"] * e if self._time("tTn") else 0.0
        self.before = setpoint * (self.rows["bDInTheFeedbackPath"] == "FALSE") - measured

    def step(self, setpoint: float, measured: float, added: float = 0.0) -> float:
        h, Tn, Tv, Td = (self._time(n) for n in ("tCtrlCycleTime", "tTn", "tTv", "tTd"))
        assert h == self._time("tTaskCycleTime")
        P = setpoint * (self.rows["bPInTheFeedbackPath"] == "FALSE") - measured
        now = setpoint * (self.rows["bDInTheFeedbackPath"] == "FALSE") - measured
        self.integral += self["fKp"] * h / Tn * (setpoint - measured) if Tn else 0.0
        self.derivative = (Td * self.derivative + self["fKp"] * Tv * (now - self.before)) / (Td + h)
        self.before = now
        out = _clip(self["fKp"] * P + self.integral + self.derivative, self["fOutMinLimit"], self["fOutMaxLimit"])
        return self.wire(out + added)

    def wire(self, out: float) -> float:
        return self["Behind the block: offset"] + self["Behind the block: factor"] * out

    @property
    def stopped(self) -> list[float]:
        return [self.wire(0.0), self.wire(self["fManSyncValue"])]


@dataclass
class Codesys:
    """``Y = KP (e + 1/TN int e dt + TV de/dt) + Y_OFFSET``; PD has no TN."""

    rows: Mapping[str, str]
    cycle: float
    integral: float = 0.0
    before: float = 0.0

    def __getitem__(self, name: str) -> float:
        return float(self.rows[f"{self.block}.{name}"])

    @property
    def block(self) -> str:
        return next(iter(self.rows)).partition(".")[0]

    def start(self, setpoint: float, measured: float) -> None:
        e = setpoint - measured
        if self.block == "PID_FIXCYCLE":
            assert self["CYCLE"] == self.cycle
            self.integral = (self["Y_MANUAL"] - self["Y_OFFSET"]) / self["KP"] - e
        self.before = e

    def step(self, setpoint: float, measured: float, added: float = 0.0) -> float:
        e = setpoint - measured
        if self.block == "PID_FIXCYCLE":
            self.integral += e * self.cycle / self["TN"]
        Y = self["KP"] * (e + self.integral + self["TV"] * (e - self.before) / self.cycle) + self["Y_OFFSET"] + added
        self.before = e
        return Y if self["Y_MIN"] == self["Y_MAX"] == 0 else _clip(Y, self["Y_MIN"], self["Y_MAX"])

    @property
    def stopped(self) -> list[float]:
        return [self["Y_MANUAL"], self["Y_OFFSET"]]


@dataclass
class Simulink:
    """``P (b r - y) + I Ts z/(z - 1) (r - y) + D N/(1 + N Ts z/(z - 1)) (c r - y)``."""

    rows: Mapping[str, str]
    integral: float = 0.0
    filter: float = 0.0

    def __getitem__(self, name: str) -> float:
        return float(self.rows[name])

    def start(self, setpoint: float, measured: float) -> None:
        assert (self.rows["Form"], self.rows["Time domain"]) == ("Parallel", "Discrete-time")
        if "I" in self.rows["Controller"]:
            self.integral = self["Integrator initial condition"]
        if "D" in self.rows["Controller"]:
            self.filter = self["Filter initial condition"] if "N" in self.rows else 0.0
            self.before = self["c"] * setpoint - measured

    def step(self, setpoint: float, measured: float, added: float = 0.0) -> float:
        h, u = self["Sample time"], self["P"] * (self["b"] * setpoint - measured)
        if "I" in self.rows["Controller"]:
            self.integral += self["I"] * h * (setpoint - measured)
            u += self.integral
        if "D" in self.rows["Controller"]:
            u += self._derivative(self["c"] * setpoint - measured, h)
        if self.rows["Limit output"] == "on":
            u = _clip(u, self["Lower limit"], self["Upper limit"])
        return self.wire(u + added)

    def _derivative(self, now: float, h: float) -> float:
        """The filter's own integrator by backward Euler: its output is N (D v - x), x' = that output."""
        if self.rows["Use filtered derivative"] == "off":
            before, self.before = self.before, now
            return self["D"] * (now - before) / h
        N = self["N"]
        out = N * (self["D"] * now - self.filter) / (1 + N * h)
        self.filter += h * out
        return out

    def wire(self, out: float) -> float:
        return self["Behind the block: offset"] + self["Behind the block: factor"] * out

    @property
    def stopped(self) -> list[float]:
        return [self.wire(0.0)]


def emulations(maker: str, text: str, cycle: float, heading: str = "Settings") -> list:  # type: ignore[type-arg]
    """The blocks that a sheet sets up."""
    rows = read_settings(text, heading)
    if maker != "rockwell":
        own = {"siemens": Siemens, "beckhoff": Beckhoff, "simulink": Simulink}
        return [Codesys(rows, cycle)] if maker == "codesys" else [own[maker](rows)]
    found: list = [RockwellPID(rows)] if "PID .KP" in rows else []  # type: ignore[type-arg]
    return found + ([RockwellPIDE(rows)] if "PIDE PGain" in rows else [])


def is_close(a: float, b: float, scale: float) -> bool:
    """Equal to the nine digits that are typed in."""
    return math.isclose(a, b, rel_tol=1e-8, abs_tol=1e-7 * scale)
