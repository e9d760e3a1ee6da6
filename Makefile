# Everything a fresh machine needs is Python 3.11, 3.12 or 3.13, and make.
# On a machine with a CUDA driver and no wish for the multi-gigabyte GPU build of torch, install
# from an index of CPU builds: make results PIP_FLAGS='--extra-index-url <address of that index>'

PYTHON ?= python3
VENV ?= .venv
PIP_FLAGS ?=
PRESET ?= quick
SLOW ?=
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# Python compiles what is imported, when it is: a fifth of all that pip would compile.
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile $(PIP_FLAGS) -c constraints.txt
# One thread per process: the harness and pytest-xdist use the cores by processes.
export OMP_NUM_THREADS ?= 1
export MPLBACKEND ?= Agg
# The many processes that tests start read what the first of them has compiled.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help env results test pytest examples lint type format docs figures dist clean
.DEFAULT_GOAL := help

help: ## Say what there is
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/' | expand -t 12

env: $(STAMP) ## Virtual environment with the pinned packages

$(STAMP): constraints.txt setup.cfg pyproject.toml
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if (3, 11) <= v <= (3, 13) else "Python 3.11 to 3.13 is needed, $(PYTHON) is %d.%d: make PYTHON=python3.13" % v)'
	@echo "Setting up $(VENV): the pinned packages, one to five minutes"
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@$(PIP) setuptools wheel
	@$(PIP) torch==$(shell sed -n 's/^torch==//p' constraints.txt)
	@$(PIP) --no-build-isolation -e '.[benchmarks,classic,render,dev]'
	@touch $@

results: $(STAMP) ## Train, plan, compare, print the tables (PRESET=quick)
	@$(BIN)/python -m benchmarks run --preset $(PRESET)

test: lint type pytest ## Lint, types, tests (SLOW=1: also those of over ten seconds each, as in CI)

# The exact figures and the kernels that the tests ask for are those of the CPU, on a machine with a GPU too.
# One worker more than cores: some tests wait. Files go out in the order of tests/conftest.py.
CORES := $(shell env -u OMP_NUM_THREADS nproc 2>/dev/null || getconf _NPROCESSORS_ONLN)
pytest: $(STAMP) ## Tests alone
	@CUDA_VISIBLE_DEVICES= $(BIN)/python -m pytest -q -n $$(($(CORES) + 1)) \
	  --dist loadfile --no-loadscope-reorder --max-worker-restart 0 $(if $(SLOW),,-m "not slow")

examples: $(STAMP) ## Every block of README and docs whole, its score as the page prints it: half an hour, weekly
	WHOLE=1 $(BIN)/python -m pytest -q tests/test_docs.py -k blocks --timeout 7200

lint: $(STAMP) ## ruff
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check --quiet . || { echo "run: make format"; exit 1; }

type: $(STAMP) ## mypy
	@$(BIN)/mypy -n 2

format: $(STAMP) ## Rewrite the sources in the house's form
	@$(BIN)/ruff check --fix --quiet .
	@$(BIN)/ruff format --quiet .

docs: $(STAMP) ## The site, in build/docs/index.html
	@$(BIN)/python -m sphinx -W --keep-going -q docs build/docs

figures: $(STAMP) ## Regenerate the figures and numbers of README, design, results and learning
	@$(BIN)/python -m benchmarks study design
	@$(BIN)/python -m benchmarks report --preset paper
	@$(BIN)/python -m benchmarks report --preset cut
	@for preset in support scale grid; do $(BIN)/python -m benchmarks report --preset $$preset || exit 1; done
	@$(BIN)/python -m benchmarks study media
	@$(BIN)/python -m benchmarks study audit
	@$(BIN)/python -m benchmarks study failures

dist: $(STAMP) ## Wheel and sdist in dist/, each installed into an empty environment and tried
	@rm -rf dist build/dist && mkdir -p build/dist
	@$(BIN)/python -m build --no-isolation --outdir dist . > build/dist/log || { cat build/dist/log; exit 1; }
	@for file in dist/*.whl dist/*.tar.gz; do \
	  echo "Installing $$file into an empty environment"; rm -rf build/dist/venv; \
	  $(BIN)/python -m venv build/dist/venv && \
	  build/dist/venv/bin/python -I -m pip install --quiet --disable-pip-version-check $(PIP_FLAGS) -c constraints.txt setuptools wheel && \
	  build/dist/venv/bin/python -I -m pip install --quiet --disable-pip-version-check $(PIP_FLAGS) -c constraints.txt --no-build-isolation $$file && \
	  (cd build/dist && venv/bin/python -I -c 'import coop_env, gymnasium, sb3_rainbow; print(sb3_rainbow.Rainbow("MlpPolicy", gymnasium.make("CoopInsertion-v0", reward="progress"), learning_starts=100).learn(300).num_timesteps, "steps with", sb3_rainbow.__file__)') || exit 1; \
	done; rm -rf build/dist; ls -l dist

clean: ## Remove the environment and caches; results/ stays
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .coverage htmlcov
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
