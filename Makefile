# Every target installs its dependencies into `.venv`. GNU make and Python 3.11 or newer
# are required. `make help` lists the targets.

# To choose the interpreter: `make PYTHON=/path/to/python test`.
PYTHON ?=
# The versions that the tests run on. Version managers put stubs on the path that fail
# until a version is selected, so the interpreters that they hold are candidates too.
VERSIONS := 3.13 3.12 3.11
MANAGED := $(or $(PYENV_ROOT),$(HOME)/.pyenv)/versions \
	$(or $(ASDF_DATA_DIR),$(HOME)/.asdf)/installs/python \
	$(HOME)/.local/share/mise/installs/python $(HOME)/.local/share/uv/python
candidates = $(or $(PYTHON),$(foreach version,$(1),python$(version) \
	$(wildcard $(addsuffix /*/bin/python$(version),$(MANAGED)))) python3)
VENV := .venv
OLDEST := .venv-oldest
BIN := $(VENV)/bin
PIP := -m pip --quiet --disable-pip-version-check install
# Number of processes of tests and examples. `make test WORKERS=auto` uses all cores.
WORKERS ?= 2
PYTEST = -m pytest -q -n $(WORKERS) --dist worksteal

EXAMPLES := $(sort $(filter-out examples/_%,$(wildcard examples/*.py)))
# The experiments of the paper share code, so they are run as modules.
PAPER := $(notdir $(basename $(filter-out examples/paper/_%,$(wildcard examples/paper/*.py))))
BENCHMARKS := against_loop calls compile_time schemes tuning work_precision choose_step batches \
	nonseparable gauss multistep friction forces variable_steps constraints bodies manifolds hard_cases \
	gradients saved samplers limits

# Figures are saved to files, without a display.
export MPLBACKEND ?= Agg

.DEFAULT_GOAL := help
.PHONY: help demo test slow mutants typed oldest lint format docs serve tutorials examples paper bench clean
# The targets share one environment, so they must not run in parallel.
.NOTPARALLEL:
.DELETE_ON_ERROR:

help:  ## List the targets
	@sed -n 's/^\([a-z]*\):.*##  *\(.*\)/  make \1|\2/p' $(MAKEFILE_LIST) \
		| while IFS='|' read -r name text; do printf '%-16s %s\n' "$$name" "$$text"; done

demo: $(VENV)/.with-examples  ## Run the quick start: print its tables and save its figure
	@$(BIN)/python examples/quickstart.py

test: $(VENV)/.with-tests  ## Run the tests, except the slow ones
	@$(BIN)/python $(PYTEST) -m "not slow"

# `make slow PART=1/8` runs one eighth of them.
slow: $(VENV)/.with-tests  ## Run the slow tests
	@$(BIN)/python $(PYTEST) -m slow $(if $(PART),--part $(PART))

# Each of many errors is made in a copy of the package, which takes hours.
# `make mutants ONLY="loop friction"` takes those with one of these words in their name.
mutants: $(VENV)/.with-tests  ## Count the deliberate errors that the tests find
	@$(BIN)/python tests/mutants.py $(ONLY)

# Left out are tests that pass arguments of wrong types on purpose.
typed: $(VENV)/.with-tests  ## Run tests with annotations checked at run time
	@$(BIN)/python $(PYTEST) -m "not slow" -k "not bad_input" \
		--jaxtyping-packages=diffrax_presym,beartype.beartype \
		$(addprefix tests/test_,order.py friction.py wrappers.py diagnostics.py step_density.py)

# By default the code of the documentation, which covers most features, what is private
# in Diffrax, and masses, of which gradients with constraints failed there. `make oldest
# TESTS=tests` runs all tests. Deprecation warnings between old versions are ignored.
oldest: TESTS ?= $(addprefix tests/test_,docs.py diffrax_contract.py masses.py)
oldest: $(OLDEST)/.installed  ## Test the documentation with the oldest dependencies
	@$(OLDEST)/bin/python $(PYTEST) -W ignore::DeprecationWarning $(TESTS)

lint: $(VENV)/.with-lint  ## Check style and types
	@$(BIN)/ruff check
	@$(BIN)/ruff format --check
	@$(BIN)/pyright --pythonpath $(BIN)/python

format: $(VENV)/.with-lint  ## Format the code and apply automatic fixes
	@$(BIN)/ruff check --fix
	@$(BIN)/ruff format

docs: $(VENV)/.with-docs  ## Build the documentation into site/
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs --quiet build --strict --clean
	@echo "Documentation built: open site/index.html"

serve: $(VENV)/.with-docs  ## Serve the documentation with live reload
	@$(BIN)/mkdocs serve

tutorials: $(VENV)/.with-examples  ## Run tutorials and how-to pages, save their figures
	@$(BIN)/python docs/_tutorials.py

examples: $(VENV)/.with-examples  ## Run a short version of every example
	@printf '%s\n' $(EXAMPLES) $(addprefix '-m examples.paper.',$(PAPER)) \
		| xargs -P $(WORKERS) -I{} sh -c 'output=$$($(BIN)/python {} --quick 2>&1); \
			status=$$?; printf "%s\n" "--- {} --quick" "$$output"; exit $$status'

paper: $(VENV)/.with-examples  ## Reproduce the figures and tables of the paper
	@set -e; for name in $(PAPER); do \
		echo "--- $$name"; $(BIN)/python -m examples.paper.$$name --docs; \
	done

bench: $(VENV)/.with-benchmarks  ## Run every benchmark
	@set -e; for name in $(BENCHMARKS); do \
		echo "--- $$name"; $(BIN)/python benchmarks/$$name.py; \
	done

clean:  ## Remove the environments and all build outputs
	@rm -rf $(VENV) $(OLDEST) site build dist .pytest_cache .ruff_cache *.egg-info
	@find . -name __pycache__ -prune -exec rm -rf {} +

# Run once per set of extras, and again when the dependencies change.
$(VENV)/.with-%: pyproject.toml | $(BIN)/pip
	@echo "Installing diffrax_presym[$*] into $(VENV) ..."
	@$(BIN)/python $(PIP) --editable '.[$*]'
	@touch $@

# $(call venv,folder,versions): an environment of the first candidate that runs.
define venv
@for python in $(call candidates,$(2)); do \
	if found=$$("$$python" -c 'import ensurepip, sys, venv; \
			sys.exit("too old") if sys.version_info < (3, 11) else print(sys.version)' \
			2>/dev/null); then \
		echo "Creating $(1) with Python $${found%% *} ($$python) ..."; \
		exec "$$python" -m venv $(1); \
	fi; \
done; \
echo "No usable Python found (tried: $(call candidates,$(2)))." >&2; \
echo "Python 3.11 or newer is needed, with its venv module (on Debian and Ubuntu: apt-get install python3-venv). Choose one with 'make PYTHON=/path/to/python ...'." >&2; \
exit 1
endef

# The newest Python.
$(BIN)/pip:
	$(call venv,$(VENV),$(VERSIONS))

# The oldest Python, and the lowest versions that `pyproject.toml` allows and that need
# no compiler there.
$(OLDEST)/.installed: pyproject.toml | $(BIN)/pip
	@rm -rf $(OLDEST)
	$(call venv,$(OLDEST),$(sort $(VERSIONS)))
	@echo "Installing the oldest allowed dependencies into $(OLDEST) ..."
	@$(BIN)/python $(PIP) uv
	@$(BIN)/uv --quiet pip install --python $(OLDEST)/bin/python \
		--resolution lowest-direct --only-binary scipy --only-binary matplotlib \
		--editable '.[tests]'
	@touch $@
