# Sets everything up in .venv by itself and asks for nothing but python3 (3.11 or later), its venv module and make.
# The set-up is done again only when pyproject.toml or constraints.txt has changed, or the folder has moved.

PYTHON ?= python3
ARGS ?=

# Tests and commands start hundreds of processes, which read the modules of maxq compiled by the first one.
unexport PYTHONDONTWRITEBYTECODE

VENV := .venv
PY := $(VENV)/bin/python
PIP := $(PY) -m pip --disable-pip-version-check
# A venv holds absolute paths: one that was copied or moved along with its folder is set up again.
PLACE := $(VENV)/set-up-in
TO_FLY := $(VENV)/ready-to-fly
TO_TEST := $(VENV)/ready-to-test

.PHONY: help fly test test-long test-lowest test-slim test-browser docs coverage lint format FORCE
.DELETE_ON_ERROR:

help:  ## say what there is to make
	@echo "make TARGET [ARGS='...']"
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  \1\t\2/p' Makefile

fly: $(TO_FLY)  ## fly scenarios/nominal.toml; ARGS go to simrun
	@echo "Flying scenarios/nominal.toml with simrun."
	@$(PY) $(VENV)/bin/simrun scenarios/nominal.toml $(ARGS)

test: $(TO_TEST)  ## run the tests; ARGS go to pytest (ARGS="-m 'not slow'" leaves out the slow ones)
	@echo "Running the tests with pytest."
	@$(PY) -m pytest -n auto --dist worksteal -m "not long" $(ARGS)

test-long: $(TO_TEST)  ## run the few tests that make test leaves out for their time
	@echo "Running the long tests with pytest."
	@$(PY) -m pytest -n auto --dist worksteal -m long $(ARGS)

# Of each part that a requirement serves: kernels and a nominal flight (numba), logs, campaigns here and on a cluster
# (pyarrow, dask), plots, reports, files, the replay (rerun-sdk).
OF_BOUNDS := $(patsubst %,tests/test_%.py,usage_good_guest invariants_compiled invariants_own_kernels usage_cache \
	regression_nominal oracle_tables oracle_vectors oracle_noise invariants_packing oracle_log_mcap invariants_log \
	usage_log usage_python usage_without_viewer usage_simreplay usage_replay_rendered usage_campaign_files \
	invariants_campaign_cluster usage_pictures usage_terminal usage_upgrade)
TEST_TOOLS := pytest hypothesis control packaging pillow psutil
LOWEST := .venv-lowest
SLIM := .venv-slim

test-lowest: $(TO_TEST)  ## install the lowest version of each requirement into .venv-lowest, and run tests of each
	@echo "Testing with the lowest versions that pyproject.toml allows (about ten minutes)."
	@$(PYTHON) -m venv --clear $(LOWEST)
	@$(PY) -m maxq.tools.dev.lowest > $(LOWEST)/constraints.txt
	@$(LOWEST)/bin/python -m pip --disable-pip-version-check install --quiet -c $(LOWEST)/constraints.txt setuptools
	@$(LOWEST)/bin/python -m pip --disable-pip-version-check install --quiet -c $(LOWEST)/constraints.txt \
		--no-build-isolation --editable '.[dask]' $(TEST_TOOLS) pandas polars sympy xarray
	@MPLBACKEND=Agg MAXQ_CACHE=$(CURDIR)/$(LOWEST)/cache $(LOWEST)/bin/python -m pytest -q -p no:cacheprovider \
		$(ARGS) $(OF_BOUNDS)

test-slim: $(PLACE)  ## install maxq without the viewer into .venv-slim (requirements-slim.txt), and test that all else works
	@echo "Testing maxq as a worker of a cluster has it, without the viewer (about three minutes)."
	@$(PYTHON) -m venv --clear $(SLIM)
	@$(SLIM)/bin/python -m pip --disable-pip-version-check install --quiet -r requirements-slim.txt
	@$(SLIM)/bin/python -m pip --disable-pip-version-check install --quiet --no-deps .
	@du -sh $(SLIM)
	@$(SLIM)/bin/python -m pip --disable-pip-version-check install --quiet $(TEST_TOOLS)
	@MPLBACKEND=Agg MAXQ_CACHE=$(CURDIR)/$(SLIM)/cache $(SLIM)/bin/python -m pytest -q -p no:cacheprovider \
		$(ARGS) tests/test_usage_without_viewer.py

test-browser: $(TO_TEST)  ## open `simreplay --web` and report pages in headless Chromium, and look at them
	@echo "Opening simreplay --web and report pages in headless Chromium."
	@$(PY) -m pytest tests/browser_replay.py tests/browser_pages.py tests/browser_workbench.py -rs $(ARGS)

docs: $(TO_TEST)  ## build the documentation site into docs/build/html; its notebooks are executed
	@echo "Building the documentation (about a minute; with the first flight of this checkout twenty seconds more)."
	@$(PY) -m sphinx -q -W --keep-going -b html docs docs/build/html $(ARGS)
	@echo "docs/build/html/index.html"

verify: $(TO_TEST)  ## verify the simulator itself: rerun all that docs/verification.md says, and rewrite its tables
	@echo "Verifying the simulator (about fifteen minutes)."
	@$(PY) -m maxq.tools.dev.verification.nesc
	@$(PY) -m maxq.tools.dev.verification.planted
	@$(PY) -m maxq.tools.dev.verification.certificates
	@$(PY) -m pytest -q tests/test_order_*.py tests/test_invariants_*.py tests/test_oracle_*.py tests/test_reference_*.py $(ARGS)

# The tests that end soon without a compiler: kernels by themselves, and flights of a few steps.
UNCOMPILED := $(patsubst %,tests/test_%.py,invariants_computer invariants_control_converter invariants_control_roll \
	invariants_environment_atmosphere invariants_environment_earth oracle_control_guidance oracle_control_law \
	oracle_dynamics oracle_dynamics_signs oracle_environment_earth oracle_environment_turbulence \
	oracle_environment_wind oracle_filters oracle_flight_injection oracle_noise oracle_tables \
	reference_environment_atmosphere usage_computer usage_filters) \
	tests/test_usage_simrun.py::test_a_flight_from_python_equals_the_one_in_the_log

coverage: $(TO_TEST)  ## say which lines of control/ and sim/ the tests run; kernels run as Python, so without the slow flights
	@echo "Measuring coverage with kernels as plain Python (about five minutes)."
	@NUMBA_DISABLE_JIT=1 $(PY) -m pytest -q -m "not slow" --cov=control --cov=sim --cov-report=term:skip-covered \
		$(ARGS) $(UNCOMPILED)

lint: $(TO_TEST)  ## check style, format, types, the direction of imports and the English
	@echo "Checking style and format (ruff), types (mypy), imports (import-linter) and English (tools/dev/prose.py)."
	@failed=; \
	$(PY) -m ruff check . || failed="$$failed style"; \
	$(PY) -m ruff format --check --quiet . || failed="$$failed format(make-format-repairs-it)"; \
	$(PY) -m mypy || failed="$$failed types"; \
	PYTHONPATH=tools/.ns $(PY) $(VENV)/bin/lint-imports --no-logo || failed="$$failed imports"; \
	$(PY) -m maxq.tools.dev.prose || failed="$$failed English"; \
	if [ -n "$$failed" ]; then echo "lint: wrong:$$failed" >&2; exit 1; fi

format: $(TO_TEST)  ## put the sources into ruff's format
	@echo "Formatting the sources (ruff)."
	@$(PY) -m ruff format .

ifneq ($(shell cat $(PLACE) 2>/dev/null),$(CURDIR))
$(PLACE): FORCE
endif

$(PLACE):
	@command -v $(PYTHON) >/dev/null || { echo "maxq needs Python 3.11 or later, and there is no $(PYTHON): install it (Debian, Ubuntu: apt install python3 python3-venv), or name one with make PYTHON=..." >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "maxq needs Python 3.11 or later, and $(PYTHON) is $$($(PYTHON) --version 2>&1): name a later one with make PYTHON=..." >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { echo "$(PYTHON) cannot make virtual environments: install its venv module (Debian, Ubuntu: apt install python3-venv)" >&2; exit 1; }
	@echo "Making the virtual environment $(VENV)."
	@$(PYTHON) -m venv $(VENV)
	@rm -f $(TO_FLY) $(TO_TEST)
	@echo "$(CURDIR)" > $@

# setuptools first, in the version of constraints.txt: a build in isolation would take whichever is newest
$(TO_FLY): $(PLACE) pyproject.toml constraints.txt
	@echo "Installing maxq and what it needs into $(VENV) (about a minute the first time)."
	@$(PIP) install --quiet --constraint constraints.txt setuptools
	@$(PIP) install --quiet --constraint constraints.txt --no-build-isolation --editable .
	@touch $@

# All at once: after an installation to fly, pip would resolve and build a second time.
$(TO_TEST): $(PLACE) pyproject.toml constraints.txt
	@echo "Installing maxq and what its tests and linters need into $(VENV)."
	@$(PIP) install --quiet --constraint constraints.txt setuptools
	@$(PIP) install --quiet --constraint constraints.txt --no-build-isolation --editable '.[test,lint,docs]'
	@touch $(TO_FLY) $@

# --- benchmarks: the programs compared with live in an environment of their own, since some pin what maxq needs newer
BENCH := .venv-bench
BENCH_PY := $(BENCH)/bin/python
PEERS := jsbsim==1.3.3 bsk==2.12.1 'rocketpy==1.13.*'

.PHONY: bench

bench: $(TO_FLY) $(BENCH)/ready  ## measure speed, precision and memory beside other programs; ARGS go to tools/dev/bench/run.py
	@echo "Measuring (about five minutes; the machine should have nothing else to do)."
	@$(PY) -m maxq.tools.dev.bench.run $(ARGS)

# maxq without what it needs: the workers there take only their way of answering from it
$(BENCH)/ready: $(PLACE) Makefile
	@echo "Installing the programs compared with into $(BENCH) (about a minute the first time)."
	@$(PYTHON) -m venv --clear $(BENCH)
	@echo '*' > $(BENCH)/.gitignore
	@$(BENCH_PY) -m pip --disable-pip-version-check install --quiet $(PEERS)
	@$(BENCH_PY) -m pip --disable-pip-version-check install --quiet --constraint constraints.txt setuptools
	@$(BENCH_PY) -m pip --disable-pip-version-check install --quiet --no-deps --no-build-isolation --editable .
	@touch $@
