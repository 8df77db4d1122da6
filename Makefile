# Needs Python 3.11 to 3.13, pip and make, nothing else.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.PHONY: demo test check format clean bench campaign campaign-measurements campaign-pixels campaign-real

demo: $(READY)
	$(BIN)/surecut demo

test: check
	$(BIN)/pytest -n auto

check: $(READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright --pythonpath $(BIN)/python

format: $(READY)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

$(READY): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade pip
	$(BIN)/pip install --quiet --editable . --group dev
	touch $@

bench: $(READY)
	OMP_NUM_THREADS=2 $(BIN)/python benchmarks/run.py --gate 2.0

# docs/validation.md, all of it: every section comes from one of these commands.
CAMPAIGN = $(BIN)/surecut campaign --jobs 2 --validation docs/validation.md
REAL ?= ../shared/data

campaign: campaign-measurements campaign-pixels campaign-real

campaign-measurements: $(READY)
	$(CAMPAIGN) -o logs/campaign --runs 1000
	$(CAMPAIGN) -o logs/outliers --scenario outliers --runs 100 --against logs/campaign
	$(CAMPAIGN) -o logs/half-noise --scenario half-noise --runs 100 --against logs/campaign
	$(CAMPAIGN) -o logs/paper-a --scenario paper-a --runs 90
	$(CAMPAIGN) -o logs/paper-b --scenario paper-b --runs 90
	$(CAMPAIGN) -o logs/evidence --leave-out --sensitivity --runs 20
	$(CAMPAIGN) -o logs/decisions --decisions --runs 200
	$(CAMPAIGN) -o logs/validation --scenario validation --runs 300 --range estimator/validated_range.yaml

campaign-pixels: $(READY)
	$(CAMPAIGN) -o logs/pixels --level pixels --scenario validation --runs 42 --recordings logs/recordings

campaign-real: $(READY)
	$(CAMPAIGN) -o logs/real --real $(REAL)

clean:
	rm -rf $(VENV) build *.egg-info
