"""A buck converter (measured): a linear plant about an operating point that nobody has stated, and its diode.

    python problems/identify/buck.py --datasets DIR [--json FILE]

The log counts neither its input nor its output from where a linear plant does. `plant.input_offset` holds both; it is
freed because the log shows it, and rows linear.plant.* are held to a fit by SciPy. Yet steps up and down are no mirror
images: the diode lets no current back, and the output falls no faster than the load empties the capacitor. So a model
of one's own by `po.define`: coil, capacitor, load, and a diode that closes as the current vanishes. Both are fitted on
the first half of the record. Rows *.forecast: a free run of the second half, its start state from the first tenth,
and the error behind that.

Data: W. R. Lacerda Junior, sysidentpy-data (MIT), a record of 20 ms in two halves.
"""

import sys
import time
from collections.abc import Mapping
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import casadi as ca
import pandas as pd

import pneuopt as po
from problems.shared.claims import Claim, arguments, finish, frame

SCIPY = {  # `least_squares` on the first half, start state and offset free
    "plant.gain": -7.6944,
    "plant.natural_frequency": 5317.1,
    "plant.damping": 0.34711,
    "plant.input_offset": 4.0832,
}
FORECASTS = {"diode": "<= 0.2"}  # [V]
LINES = 40
Symbols = Mapping[str, ca.SX]

# the model begins
UNKNOWN = {  # a guess, its unit and its range
    "bridge.gain": (-8.0, "1", -100.0, 0.0),
    "bridge.offset": (4.0, "V", 0.0, 10.0),
    "coil.frequency": (5e3, "rad/s", 1e3, 1e5),
    "coil.damping": (0.1, "1", 1e-3, 10.0),
    "load.time": (3e-3, "s", 1e-4, 1.0),
}
SMALL = 100.0  # [V/s] of the current over which the diode closes


def rhs(_t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
    w, current = p["coil.frequency"], x["current"]
    drive = w**2 * (p["bridge.gain"] * (u["input"] - p["bridge.offset"]) - x["output"])
    drive -= 2 * p["coil.damping"] * w * current
    gate = ca.if_else(drive > 0, 1.0, ca.tanh(current / SMALL))
    return {"output": current - x["output"] / p["load.time"], "current": gate * drive}, {"output": x["output"]}


PARAMETERS = po.ParameterSet(
    {n: po.Parameter(*numbers, log=numbers[2] > 0, free=True) for n, numbers in UNKNOWN.items()}
)
INPUT, OUTPUT = po.Quantity("input", "V", nominal=2.0), po.Quantity("output", "V", nominal=10.0)
CURRENT = po.Quantity("current", "V/s", nominal=5e3)  # over the capacitance
CONVERTER = po.define((OUTPUT, CURRENT), (INPUT,), (OUTPUT,), PARAMETERS, rhs)
# the model ends


def read(path: Path) -> po.Experiment:
    """One half of the record."""
    columns = {"time": "sampling_time", "input": "input", "output": "y"}
    named = {channel: {"column": name, "unit": "s" if channel == "time" else "V"} for channel, name in columns.items()}
    return po.read_log(path, columns=named, plant=CONVERTER)


def main(folder: Path) -> pd.DataFrame:
    fitted, held_out = (read(folder / f"buck_{half}.csv") for half in ("id", "valid"))
    linear, claims, errors = po.SecondOrder(input=INPUT, output=OUTPUT).system(), list[Claim](), dict[str, float]()
    given = linear.parameters.freed("plant.gain", "plant.natural_frequency", "plant.damping")
    for name, model, free in (("linear", linear, given), ("diode", CONVERTER, PARAMETERS)):
        began = time.process_time()
        fit = po.identify(model, fitted, free)
        seconds = time.process_time() - began
        print(fit)
        forecast = po.validate(model, held_out, fit).iloc[0]
        errors[name] = forecast["forecast_rmse"]
        for parameter, row in fit.estimates.to_dict(orient="index").items():
            same = SCIPY.get(str(parameter))
            bound = f"{same} +- {0.01 * abs(same):.4g}" if same else ""
            claims.append(Claim(f"{name}.{parameter}", row["value"], row["unit"], same, bound))
        claims += [
            Claim(f"{name}.rmse", fit.fit["free_run_rmse"].iloc[0], "V"),
            Claim(f"{name}.forecast", errors[name], "V", None, FORECASTS.get(name, "")),
            Claim(f"{name}.cpu", seconds, "s"),
        ]
    model_text = Path(__file__).read_text(encoding="utf-8").partition("# the model begins\n")[2]
    lines = model_text.partition("# the model ends")[0].splitlines()
    claims.append(Claim("diode.over_linear", errors["diode"] / errors["linear"], "1", None, "<= 0.5"))
    return frame(
        [*claims, Claim("diode.lines", float(sum(bool(line) for line in lines)), "1", None, f"<= {LINES - 1}")]
    )


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--datasets", type=Path, metavar="DIR", required=True, help="the folder with buck")
    options = parser.parse_args()
    sys.exit(finish(main(options.datasets / "buck"), options))
