# Two commands: `make train` and `make test`. Both set everything up in .venv first, and so do the others.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
ARGS ?= --seeds 8

.PHONY: train test docs demo slow mutants lock clean

train: $(VENV)/.installed
	$(BIN)/python experiments/run.py $(ARGS)

test: $(VENV)/.installed
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/pytest -n 2 --dist loadfile

# Writes the tables of docs/tables.py into the pages and builds the site in .cache/site; any warning is an error.
docs: $(VENV)/.installed
	$(BIN)/python -m docs.tables
	-$(BIN)/python -m docs._generate.demo  # without Node.js the pages come without it
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict  # with --quiet it would count no warnings

# Builds the page on which a browser simulates the tasks, in .cache/demo; needs Node.js and npm.
demo: $(VENV)/.installed
	$(BIN)/python -m docs._generate.demo

slow: $(VENV)/.installed
	$(BIN)/pytest -m slow

# Breaks the learning core in small ways and lists the breaks that no test notices; an hour on two cores.
mutants: $(VENV)/.installed
	$(BIN)/python -m tools.mutants --sample 220

$(VENV)/.installed: requirements.lock pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	if command -v nvidia-smi > /dev/null; then $(BIN)/python -m pip install --quiet --disable-pip-version-check \
		"jax[cuda13]==$$($(BIN)/python -c 'import jax; print(jax.__version__)')" warp-lang==1.18.0; fi
	touch $@

# Pins every dependency with its hashes for Python 3.11 and later; needs uv.
lock:
	uv pip compile pyproject.toml --extra compare --extra ur5e --extra franka --extra so101 --extra docs --extra dev --universal --python-version 3.11 \
		--generate-hashes --no-emit-index-url --no-emit-find-links --no-annotate --no-header --quiet \
		--output-file requirements.lock

clean:
	rm -rf $(VENV) .cache build dist
