# Everything a person or CI does with the project; `make help` lists it.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin

.DEFAULT_GOAL := help
.PHONY: help install demo test test-fast test-nightly fuzz lint format docs notebooks resolve lock clean

help:  ## Show this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## (.*)/  make \1|\2/' | column -t -s '|'

install: $(VENV)/.installed  ## Make the virtual environment in .venv with everything that development needs

# On Linux torch from PyPI brings CUDA, 3 GB to download. Without a GPU its build for CPUs does, if pip finds it:
#   make install PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu
$(VENV)/.installed: pyproject.toml requirements/ci.txt
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))' || \
		{ echo "raytran needs Python 3.11 to 3.14; name one with: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --no-compile --requirement requirements/ci.txt
	@$(BIN)/python -m compileall -qq -j 0 $(VENV)/lib src || true  # on all cores; some packages bring templates
	$(BIN)/pip install --quiet --no-deps --editable .
	@touch $@

demo: install  ## Make rooms, train the three stages, evaluate, predict, and write one page to look at (CPU, minutes)
	$(BIN)/raytran demo

test: install  ## Run all tests but those of the night
	OMP_NUM_THREADS=1 $(BIN)/pytest -n 2 --dist worksteal -m 'not nightly'

test-fast: install  ## Run the tests that take less than ten seconds each
	OMP_NUM_THREADS=1 $(BIN)/pytest -n 2 --dist worksteal -m 'not slow and not nightly'

test-nightly: install  ## Run the tests of the night, which take minutes each
	OMP_NUM_THREADS=1 RAYTRAN_TEST_KILLS=10 $(BIN)/pytest -m nightly

fuzz: install  ## Give all readers 10,000 damaged and hostile inputs (one core, some 15 minutes; finds go to fuzz-findings/)
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.fuzz --inputs 10000 --seed $${SEED:-0}

lint: install  ## Check format, style and types
	$(BIN)/ruff format --check src tests benchmarks docs notebooks
	$(BIN)/ruff check src tests benchmarks docs notebooks
	$(BIN)/mypy

format: install  ## Rewrite the sources in the project's format
	$(BIN)/ruff format src tests benchmarks docs notebooks
	$(BIN)/ruff check --fix src tests benchmarks docs notebooks

docs: install build/docs/.installed  ## Write the tables of settings into docs/ from conf/, and the site into build/site
	$(BIN)/python docs/options.py
	NO_MKDOCS_2_WARNING=1 build/docs/bin/mkdocs build --strict

# The extra "docs" without raytran itself and torch: the site is made of sources, which nothing imports.
build/docs/.installed: pyproject.toml
	$(PYTHON) -m venv build/docs
	build/docs/bin/pip install --quiet $$($(BIN)/python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["docs"])')
	@touch $@

notebooks: install  ## Execute the notebooks and keep what they print and draw
	OMP_NUM_THREADS=1 $(BIN)/python notebooks/execute.py

resolve: build/uv/bin/uv  ## Check that PyPI alone has versions for every way to install, Python and torch (downloads no package)
	PATH="build/uv/bin:$$PATH" requirements/resolve.sh

lock: build/uv/bin/uv  ## Write uv.lock: the versions of requirements/ci.txt, and of all extras, with hashes
	PATH="build/uv/bin:$$PATH" requirements/lock.sh

build/uv/bin/uv:
	$(PYTHON) -m venv build/uv
	build/uv/bin/pip install --quiet uv

clean:  ## Remove the virtual environment and caches (not data/, not outputs/)
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache dist build
