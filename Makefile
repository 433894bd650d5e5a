# Two commands: `make sim` flies the default mission, `make test` runs all that CI runs. Both make the environment first.
PYTHON ?= python3
VENV := .venv
STAMP := $(VENV)/.installed

.PHONY: sim test lint clean

sim: $(STAMP)
	$(VENV)/bin/podwatch sim

test: $(STAMP) lint
	$(VENV)/bin/python -m pytest -n 2 --dist worksteal

lint: $(STAMP)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

# Made anew when the dependencies or the messages change.
$(STAMP): pyproject.toml $(wildcard lcmtypes/*.lcm) lcmtypes/hatch_build.py tools/make_venv.sh
	sh tools/make_venv.sh $(PYTHON) $(VENV)
	touch $@

clean:
	rm -rf $(VENV) lcmtypes/podwatch dist build
