PYTHON ?= python3
BIN := .venv/bin
INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps

# Processes that tests start load compiled sources: 0.1 s less for each of them.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: install demo test test-deployment lint bench docs golden lock clean

install: .venv/.runtime

demo: .venv/.runtime
	rm -rf demo
	$(BIN)/lidarops simulate catalogs/demo.yaml
	$(BIN)/python -m flows.reprocess catalogs/demo.yaml

test: .venv/.dev
	$(BIN)/python -m pytest -q -n auto --maxprocesses 4 --dist loadfile

# Schedules on SQLite and PostgreSQL, and Slurm: needs their Debian packages, and root for Slurm.
test-deployment: .venv/.dev
	$(BIN)/python -m pytest -q -m deployment

lint: .venv/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# The products and the picture that tests compare with; look at the difference before you commit it.
golden: .venv/.dev
	PYTHONPATH=tests $(BIN)/python -m golden.regenerate
	$(BIN)/python docs/architecture_picture.py

# The documentation: docs/_build/html/index.html. Notebooks run again when code has changed.
docs: .venv/.dev
	$(BIN)/python -m sphinx --fail-on-warning --quiet -b html docs docs/_build/html

# Error against run time of every retrieval: bench/result.json, and charts.
bench: .venv/.dev
	$(BIN)/python -m benchmarks accuracy --out bench

.venv/.runtime: requirements.lock pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(INSTALL) --require-hashes -r requirements.lock
	$(INSTALL) --no-build-isolation -e .
	$(BIN)/lidarops compile
	touch $@

.venv/.dev: .venv/.runtime requirements-dev.lock tests/plugin/pyproject.toml
	$(INSTALL) --require-hashes -r requirements-dev.lock
	$(INSTALL) --no-build-isolation -e tests/plugin
	PYTHONPATH=tests $(BIN)/python -m support.compilation
	touch $@

COMPILE = uv pip compile --quiet --universal --python-version 3.11 --generate-hashes \
	--no-emit-index-url --no-strip-extras --custom-compile-command "make lock" pyproject.toml

lock:
	$(COMPILE) --extra prefect -o requirements.lock
	$(COMPILE) --extra dev -c requirements.lock -o requirements-dev.lock
	$(COMPILE) --extra postgresql --extra prefect --extra s3 --extra slurm -c requirements-dev.lock \
		-o deploy/requirements.lock

clean:
	rm -rf .venv bench demo build docs/_build *.egg-info
