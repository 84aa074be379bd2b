# make demo   train, evaluate and record two small policies; see README.md
# make test   the tests and the style checks
#
# Both set up .venv first, once, and again when pyproject.toml or constraints.txt change.
# Another interpreter: make demo PYTHON=python3.12

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet

.PHONY: demo test
demo: $(VENV)/all.installed
	$(BIN)/soro-bench run --preset quick

test: $(VENV)/dev.installed
	$(BIN)/python -m pytest -n 2
	$(BIN)/ruff check
	$(BIN)/ruff format --check

$(VENV)/%.installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.version_info >= (3, 11) or sys.exit("needs Python 3.11 or newer; have " + sys.version)'
	@echo "setting up $(VENV) (some minutes the first time)"
	@test -x $(BIN)/pip || $(PYTHON) -m venv $(VENV)
	$(PIP) "$$(grep '^torch==' constraints.txt)"
	$(PIP) -c constraints.txt -e ".[$*]"
	@touch $@
