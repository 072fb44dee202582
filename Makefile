PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: train test clean

# Train a drone to hover, and leave checkpoint, metrics and pictures in outputs/.
train: $(VENV)/recipes
	$(BIN)/python recipes/abpt.py

# Lint, and run all fast tests.
test: $(VENV)/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python -m pytest -q -m "not slow"

$(VENV)/%: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[$*]"
	touch $@

clean:
	rm -rf $(VENV) outputs build dist *.egg-info
