# The same words for people and for CI. Everything is set up in .venv, nothing outside this folder is touched.
.DEFAULT_GOAL := help
SHELL := /bin/sh
VENV := .venv
BIN := $(VENV)/bin
PYTHON ?= $(shell for p in python3 python3.14 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && { echo $$p; break; }; done)
SOURCES := Cargo.toml Cargo.lock pyproject.toml $(shell find src python -name '*.rs' -o -name '*.py' -o -name '*.pyi' -o -name '*.j2')

.PHONY: help demo test test-quick bench bench-peers lint format docs clean check-tools

help:
	@echo 'make demo         scene, registration, coloured cloud and report, into demo-output/'
	@echo 'make test         all Rust and Python tests'
	@echo 'make test-quick   the same without the slow statistics'
	@echo 'make bench        the kernels (criterion)'
	@echo 'make bench-peers  against NumPy, OpenCV, SciPy, laspy and others, as ratios of one run'
	@echo 'make lint         rustfmt, clippy, ruff, mypy'
	@echo 'make format       rustfmt and ruff, in place'
	@echo 'make docs         the pictures and tables of docs/ made anew'
	@echo 'make clean        removes what was built'

check-tools:
	@if [ -z "$(PYTHON)" ]; then \
		echo 'Python 3.11 or newer is missing: install it (Debian: apt install python3 python3-venv), or say make PYTHON=/path/to/python3' >&2; exit 1; fi
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
		echo '$(PYTHON) cannot make virtual environments: install its venv module (Debian: apt install python3-venv)' >&2; exit 1; }
	@command -v cargo >/dev/null 2>&1 || { \
		echo 'Rust (cargo) is missing: install it from https://rustup.rs, version 1.89 or newer' >&2; exit 1; }
	@cargo --version | { read -r _ v _; major=$${v%%.*}; rest=$${v#*.}; minor=$${rest%%.*}; \
		[ "$$major" -gt 1 ] || [ "$$minor" -ge 89 ] || { echo "Rust $$v is too old: 1.89 or newer is needed (rustup update)" >&2; exit 1; }; }
	@command -v cc >/dev/null 2>&1 || { \
		echo 'a C linker (cc) is missing, Rust needs it: install gcc (Debian: apt install build-essential)' >&2; exit 1; }

$(BIN)/python: | check-tools
	$(PYTHON) -m venv $(VENV)

# A stamp for each kind of environment: what users have, and what developers have on top.
$(VENV)/installed: $(SOURCES) | $(BIN)/python
	@echo 'Building colourreg; the first build takes a few minutes ...'
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	@touch $@

$(VENV)/installed-dev: $(SOURCES) | $(BIN)/python
	@echo 'Building colourreg with the tools for tests; the first build takes a few minutes ...'
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $@ $(VENV)/installed

$(VENV)/installed-peers: $(VENV)/installed-dev
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev,peers]'
	@touch $@

demo: check-tools $(VENV)/installed
	$(BIN)/colourreg demo --out demo-output

test: check-tools $(VENV)/installed-dev
	cargo test --release --quiet
	$(BIN)/python -m pytest -q

test-quick: check-tools $(VENV)/installed-dev
	cargo test --release --quiet
	$(BIN)/python -m pytest -q -m 'not slow'

bench: check-tools
	cargo bench

bench-peers: check-tools $(VENV)/installed-peers
	$(BIN)/python -m benches.peers

lint: check-tools $(VENV)/installed-dev
	cargo fmt --check
	cargo clippy --release --all-targets --features python -- -D warnings
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: check-tools $(VENV)/installed-dev
	cargo fmt
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: check-tools $(VENV)/installed
	$(BIN)/colourreg reproduce all --out docs/reproduce

clean:
	rm -rf $(VENV) target build demo-output bench-output python/colourreg_rs/*.so
