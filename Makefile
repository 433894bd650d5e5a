# `make sim` flies the default mission, `make test` runs all that CI runs, `make install` is for a machine that flies or
# for the boat: the environment with what flying needs. Each makes what it needs first.
PYTHON ?= python3
VENV := .venv
FLIES := $(VENV)/.flies
TESTS := $(VENV)/.tests
SOURCES := pyproject.toml $(wildcard lcmtypes/*.lcm) lcmtypes/hatch_build.py tools/make_venv.sh

.PHONY: sim install test lint clean

sim: $(FLIES)
	$(VENV)/bin/podwatch sim

install: $(FLIES)
	@echo "installed: $(CURDIR)/$(VENV)/bin/podwatch"

test: lint
	$(VENV)/bin/python -m pytest -n 2 --dist worksteal

lint: $(TESTS)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

# Made anew when the dependencies or the messages change.
$(FLIES): $(SOURCES)
	sh tools/make_venv.sh $(PYTHON) $(VENV) .
	touch $@

# The tests also train (a few steps), which needs torch.
$(TESTS): $(SOURCES)
	sh tools/make_venv.sh $(PYTHON) $(VENV) '.[dev,train]'
	touch $@ $(FLIES)

clean:
	rm -rf $(VENV) lcmtypes/podwatch dist build
