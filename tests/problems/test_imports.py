"""Scripts use what a user has: `pneuopt`'s public names. What measures the insides is listed here, with the reason."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PUBLIC = {"pneuopt", "pneuopt.plotting"}
SEARCH = "runs a search's own simulator and merit, to compare what finds the better design with them, and how fast"
INSIDE = {
    "problems/shared/live_page.py": "runs the script of a page, which no public name gives apart from its page",
    "problems/demo/faulty_samples.py": "compares the languages' writers with the loop's own update, sample by sample",
    "problems/demo/restart_tables.py": "runs the exported program on the plants and restarts it",
    "problems/demo/export_controllers.py": "puts the library's run into the exported test, and asks for its parts",
    "problems/demo/exported_names.py": "asks a controller for its parts, and the table of names for what is reserved",
    "problems/shared/exported_words.py": "asks the table of names for what is reserved",
    "problems/shared/hostile_names.py": "is a compensator of the library's protocol, and draws from its reserved names",
    "problems/demo/forged_certificates.py": "runs the commands themselves, whose files it forges",
    "problems/shared/random_controllers.py": "draws from the registry of compensators; begins as a program does",
    "problems/shared/b32.py": "makes its logs by machine code, and times one simulation of it as the unit of cost",
    "problems/shared/random_problems.py": "finds feasible designs by brute force on the search's batched simulator",
    "problems/paper/paper_rivals.py": "tunes designs that hunt, which tune refuses, on the search's simulator",
    "problems/identify/ablation.py": "takes an attempt or a number out of the search",
    "problems/identify/good_logs.py": "asks the log doctor itself, which identify asks first",
    "problems/shared/mismatched_rig.py": "makes its logs by machine code, of the library's valve and chambers",
    "problems/speed/benchmark_identification.py": "times the full-space solver from the start that the log gives",
    "problems/shared/exact_linearisation.py": "is a compensator of the library's protocol, of its cylinder's geometry",
    "problems/shared/p32_margins.py": "reads Ms of many plants at once, and of a piston that sticks",
    "problems/shared/p32_simulator.py": "simulates sticking and slipping of many plants at once, in machine code",
    "problems/speed/linear_tuning.py": SEARCH,
    "problems/speed/batched_monte_carlo.py": "times the compiled simulation of one plant, beside many in lanes",
    "problems/speed/simulation_speed.py": "times the compiled simulation, lane by lane",
    "problems/speed/t32.py": SEARCH,
    "problems/tune/random_designs.py": "confirms refusals by brute force on the search's batched simulator",
    "problems/tune/robust_default.py": "reads the files of the commands, and the specification of random_designs",
    "problems/tune/random_kinds.py": "hands the checks of random_designs the specification that they read",
    "problems/tune/rule_comparison.py": SEARCH,
    "problems/tune/pareto.py": "times the solver along a front, and sets brute force on its designs",
    "problems/dither/margins_under_dither.py": "injects sines into the full model, one frequency a lane",
    "problems/dither/dither_map.py": "simulates the cells of a map in one batch",
}
SCRIPTS = sorted(p.relative_to(ROOT).as_posix() for p in (ROOT / "problems").rglob("*.py"))


def private_imports(script: str) -> set[str]:
    tree = ast.parse((ROOT / script).read_text(encoding="utf-8"))
    modules = {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    modules |= {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    return {m for m in modules if m.split(".")[0] == "pneuopt"} - PUBLIC


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_script_imports_public_names_only_or_is_listed_with_its_reason(script: str) -> None:
    assert bool(private_imports(script)) == (script in INSIDE), private_imports(script)


def test_what_is_listed_exists() -> None:
    assert set(INSIDE) <= set(SCRIPTS)


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_script_that_runs_finds_the_checkout_and_is_no_library(script: str) -> None:
    text = (ROOT / script).read_text(encoding="utf-8")
    assert ("sys.path.append(str(Path(__file__).parents[2]))" in text) == ("__main__" in text)
    assert "__main__" not in text or not script.startswith("problems/shared/")


def figure_names(script: str) -> list[str]:
    """How the names of a script's figures begin, as its function `figures` or what it hands to `finish` states them."""
    tree = ast.parse((ROOT / script).read_text(encoding="utf-8"))
    makers = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef) and n.name == "figures"]
    made: list[ast.expr | None] = [n.value for maker in makers for n in ast.walk(maker) if isinstance(n, ast.Return)]
    handed = [n.args[2:] for n in ast.walk(tree) if isinstance(n, ast.Call) and ast.unparse(n.func) == "finish"]
    made += [n.body for arguments in handed for n in arguments if isinstance(n, ast.Lambda)]
    keys = [key for value in made if isinstance(value, ast.Dict) for key in value.keys]
    keys += [value.key for value in made if isinstance(value, ast.DictComp)]
    return [ast.unparse(key).removeprefix("f").strip("'\"") for key in keys if key is not None]


@pytest.mark.parametrize("script", [s for s in SCRIPTS if "shared" not in s and s != "problems/demo/rig_demo.py"])
def test_a_figure_is_named_after_its_script_so_that_the_gallery_finds_it(script: str) -> None:
    stem = Path(script).stem
    assert [name for name in figure_names(script) if not name.startswith(stem)] == []
