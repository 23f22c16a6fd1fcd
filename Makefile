# Everything below sets itself up in .venv: a fresh machine needs Python 3.11+ and a C++17 compiler.
PYTHON ?= python3
BIN := .venv/bin
SOURCES := pyproject.toml CMakeLists.txt $(wildcard ldo_service/kernels/*.cpp ldo_service/kernels/*.hpp)

.PHONY: help demo test check slow bench gpu-check docs clean
help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/'

demo: .venv/installed  ## run SLAM on a built-in synthetic room: a table and three pictures
	$(BIN)/ldo demo --out build/demo --overwrite

test: .venv/tests  ## run the default tests, one process per core; ARGS="-n 0 ..." for one process
	$(BIN)/python -m pytest -q -n auto --dist worksteal $(ARGS)

slow: .venv/tests  ## run the slow tests one after the other, because each needs all cores
	$(BIN)/python -m pytest -q -m slow $(ARGS)

check: .venv/dev  ## check format, lint, types and pages
	deploy/check

bench: .venv/tests  ## run the benchmarks; docs/benchmarks has a page per question
	@for program in $(basename $(notdir $(wildcard tests/bench/bench_*.py))); do \
		echo "== $$program"; $(BIN)/python -m tests.bench.$$program || exit 1; done

gpu-check: .venv/tests  ## interpret and compile the GPU kernels; it needs no GPU and no torch
	$(BIN)/python -m pip install --quiet --group gpu-check
	LDO_ISA=baseline TRITON_INTERPRET=1 $(BIN)/python -m pytest -q -m "" -n auto --dist worksteal \
		tests/kernels/gpu tests/gaussians/test_gpu_*.py \
		tests/gaussians/test_device_fallback.py tests/tracking/test_alignment_self_test.py \
		tests/tracking/test_aligner.py tests/commands/test_doctor.py $(ARGS)
	$(BIN)/python -m tests.kernels.gpu.cubins

docs: .venv/docs  ## build the documentation site in build/site
	$(BIN)/python docs/generate.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

clean:  ## remove .venv, build and dist
	rm -rf .venv build dist

.venv/pip:
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --upgrade "pip>=25.1"
	@touch $@

# Later builds and the wheel of tests/test_packages.py reuse the objects of this build, because it
# has no isolated environment.
.venv/installed: .venv/pip $(SOURCES)
	$(BIN)/python -m pip install --quiet --group build
	$(BIN)/python -m pip install --quiet --no-build-isolation -e .
	@touch $@

.venv/tests: .venv/installed pyproject.toml
	$(BIN)/python -m pip install --quiet --group test
	@touch $@

.venv/docs: .venv/installed pyproject.toml
	$(BIN)/python -m pip install --quiet --group docs
	@touch $@

.venv/dev: .venv/tests pyproject.toml
	$(BIN)/python -m pip install --quiet --group dev
	@touch $@
