# For a new machine: `make demo` shows what it does, `make test` checks it. Both set up .venv.
#
#   make test       formulas, laws, one run end to end: minutes
#   make test-all   also browsers, notebooks, fuzzing, whole runs of every policy
#   make test-workqueue  `make test` where Numba has its own threads only (slim containers, Macs): nightly
#   make test-newest  `make test` with the newest version of every library
#   make mutants    plants every listed fault and asks whether a law notices
#   make stress     kill loops, thousands of damaged files, long runs: hours
#   make docs       the documentation, to open from its folder
#   make gpu-check  tests, benchmarks and one experiment on this machine's GPU: one table
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# One compile cache for all targets, and the commands' own: the first command after the demo finds
# what it needs.
export JAX_COMPILATION_CACHE_DIR ?= $(or $(XDG_CACHE_HOME),$(HOME)/.cache)/r3jax/jax
# Python keeps what it compiled, too: a test process saves six seconds each time.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: setup demo test test-all test-newest test-workqueue test-added mutants stress lint docs notebooks benchmark gpu-check clean

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	touch $@

demo: setup
	$(BIN)/r3jax demo

# Two processes: compiling, most of the time, runs on one core each.
PYTEST := $(BIN)/pytest -n 2 --dist worksteal

test: setup
	$(PYTEST)

test-all: test test-added

# Versions as `pip install` gives them to users, not the pinned ones: jax 0.11 and later want Python 3.12.
test-newest:
	$(PYTHON) -m venv .venv-newest
	.venv-newest/bin/pip install --quiet --upgrade --editable '.[dev]'
	$(PYTEST:$(BIN)%=.venv-newest/bin%)

# Where Numba finds neither OpenMP nor TBB: slim containers, Macs without Homebrew. For a nightly job.
test-workqueue: setup
	NUMBA_THREADING_LAYER=workqueue $(PYTEST)

# What `test-all` adds to `test`.
test-added: setup
	$(PYTEST) -m "full and not slow"

mutants: setup
	$(BIN)/python -m tests.mutants

stress: setup
	$(PYTEST) -m slow

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports
	$(BIN)/codespell r3jax tests experiments examples docs README.md CONTRIBUTING.md
	$(BIN)/python docs/hooks/words.py

# The pages, into build/site; a reference that leads nowhere fails.
docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "Open file://$(CURDIR)/build/site/index.html"

# Runs the notebooks, and saves them with their pictures: the pages show what was saved.
notebooks: setup
	$(BIN)/python -m docs.figures.notebooks

# As users run it: without the checks of types at run time that tests have.
benchmark: setup
	$(BIN)/pytest tests/benchmarks --jaxtyping-packages= --benchmark-enable --benchmark-only --benchmark-columns=min,median,rounds

# For a machine with an NVIDIA GPU, in an environment that has JAX's CUDA plug-in.
gpu-check:
	$(PYTHON) -m experiments.gpu_check

clean:
	rm -rf $(VENV) .cache build *.egg-info
