# make demo   train and evaluate two small policies, diagnose a robot with hidden physics; see README.md
# make test   the tests, the checks of style, types and imports, and the documentation site
# make docs   the documentation site, into build/site
#
# All set up .venv first, once, and again when pyproject.toml or constraints.txt change.
# Another interpreter: make demo PYTHON=python3.12

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
MKDOCS := SORO_BENCH_TUTORIALS=run NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet

.PHONY: demo test docs
demo: $(VENV)/all.installed
	$(BIN)/soro-bench run --preset quick

test: $(VENV)/dev.installed
	$(BIN)/python -m pytest -n 2 --dist worksteal
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo
	$(MKDOCS)

docs: $(VENV)/dev.installed
	$(MKDOCS)

$(VENV)/%.installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.version_info >= (3, 11) or sys.exit("needs Python 3.11 or newer; have " + sys.version)'
	@echo "setting up $(VENV) (some minutes the first time)"
	@test -x $(BIN)/pip || $(PYTHON) -m venv $(VENV)
	$(PIP) "$$(grep '^torch==' constraints.txt)"
	$(PIP) -c constraints.txt -e ".[$*]"
	@touch $@
