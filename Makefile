# A fresh machine needs Python >= 3.11 and make, nothing else: `make demo` runs the main job, `make test` all fast checks.
# Where no C compiler is on the path, the extra `compiler` is installed, too (100 MB); PNEUOPT_CC= leaves it out.
PYTHON ?= python3
ifeq ($(OS),Windows_NT)
BIN := .venv/Scripts
else
BIN := .venv/bin
endif
PY := $(BIN)/python

.PHONY: demo test coverage test-slow lint docs format clean

demo: .venv/installed
	$(PY) problems/demo/rig_demo.py --out out

test: .venv/installed lint
	$(PY) -m pytest -n 2

coverage: .venv/installed
	$(PY) -m pytest -n 2 --cov --cov-report=term

test-slow: .venv/installed
	$(PY) -m pytest -n 2 -m slow

lint: .venv/installed
	$(PY) -m ruff format --check .
	$(PY) -m ruff check .
	$(PY) -m mypy
	$(BIN)/lint-imports

docs: .venv/installed
	$(PY) -m pip install --quiet --disable-pip-version-check --group docs
	$(PY) docs/make_pages.py build/pages
	$(PY) -m sphinx --quiet --fail-on-warning --keep-going -c docs build/pages build/docs
	$(PY) docs/check_links.py build/docs

format: .venv/installed
	$(PY) -m ruff format .
	$(PY) -m ruff check --fix .

.venv/installed: pyproject.toml
	$(PYTHON) -c "import sys; sys.exit('pneuopt needs Python 3.11 or newer, this is ' + sys.version.split()[0] if sys.version_info < (3, 11) else 0)"
	$(PYTHON) -m venv .venv
	$(PY) -m pip install --quiet --disable-pip-version-check --upgrade "pip>=25.1"
	$(PY) -m pip install --quiet --disable-pip-version-check --editable . --group dev
	$(PY) -c "import os, sys; from pneuopt.dynamics.compiled.compiler import find_compiler; sys.exit(not (find_compiler() or os.environ.get('PNEUOPT_CC') == ''))" \
		|| $(PY) -m pip install --quiet --disable-pip-version-check --editable ".[compiler]" \
		|| $(PY) -c "print('no C compiler could be installed: everything runs without one, more slowly')"
	$(PY) -c "open('.venv/installed', 'w').close()"

clean:
	$(PYTHON) -c "import shutil; [shutil.rmtree(d, ignore_errors=True) for d in ('.venv', 'out', 'build')]"
