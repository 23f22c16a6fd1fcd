# Everything below sets itself up in .venv: a fresh machine needs Python 3.11+ and a C++17 compiler.
PYTHON ?= python3
BIN := .venv/bin
SOURCES := pyproject.toml CMakeLists.txt $(wildcard ldo_service/kernels/*.cpp ldo_service/kernels/*.hpp)

.PHONY: help demo test check slow bench clean
help:  ## what can be made
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/'

demo: .venv/installed  ## the main job on a built-in synthetic room: a table and three pictures
	$(BIN)/ldo demo --out build/demo --overwrite

test: .venv/tests  ## the default test suite, one process a core; ARGS="-n 0 ..." for one process
	$(BIN)/python -m pytest -q -n auto --dist worksteal $(ARGS)

slow: .venv/tests  ## the tests that take longer, one by one: each needs the cores
	$(BIN)/python -m pytest -q -m slow $(ARGS)

check: .venv/dev  ## format, lint, types
	deploy/check

bench: .venv/tests  ## the benchmarks; copy what they print to tests/bench/RESULTS.md
	@for program in $(basename $(notdir $(wildcard tests/bench/bench_*.py))); do \
		echo "== $$program"; $(BIN)/python -m tests.bench.$$program || exit 1; done

clean:  ## remove what the targets above made
	rm -rf .venv build dist

.venv/pip:
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --upgrade "pip>=25.1"
	@touch $@

.venv/installed: .venv/pip $(SOURCES)
	$(BIN)/python -m pip install --quiet -e .
	@touch $@

.venv/tests: .venv/installed pyproject.toml
	$(BIN)/python -m pip install --quiet --group test --group build
	@touch $@

.venv/dev: .venv/tests pyproject.toml
	$(BIN)/python -m pip install --quiet --group dev
	@touch $@
