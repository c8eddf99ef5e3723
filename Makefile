# From a bare machine (Debian 12, Ubuntu 24.04; git, make, python3 >= 3.11 and python3-venv) to the report:
#   make demo       set everything up and run datasets/studies/quick.toml
#   make test       set everything up and run the test suite
#   make slowtest   the evidence that takes minutes (CI runs it too)
#   make quicktest  the suite once more, stopping at the first failure
#   make lint       ruff and mypy
#   make lock       renew constraints.txt after a change of pyproject.toml

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
APT_PACKAGES := libegl1 libgl1 libgomp1 python3-venv
LIBRARIES := libEGL.so.1 libGL.so.1 libgomp.so.1
APT_LINE := apt-get update && apt-get install -y --no-install-recommends $(APT_PACKAGES)

.PHONY: demo test slowtest quicktest lint setup lock clean
.DELETE_ON_ERROR:

demo: setup
	$(BIN)/netdesign run datasets/studies/quick.toml

test: setup
	$(BIN)/python -m pytest -m "not slow"

slowtest: setup
	$(BIN)/python -m pytest -m slow

quicktest: setup
	$(BIN)/python -m pytest -m "not slow" -x --ff

lint: setup
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

setup: $(VENV)/.installed

# The virtual environment, and what it cannot bring: libEGL and libGL (Mesa) to draw without a display, OpenMP.
$(VENV)/.made:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo 'netdesign needs Python 3.11 or newer; name one with: make PYTHON=python3.12 $(MAKECMDGOALS)'; exit 1; }
	@if $(PYTHON) -c 'import ctypes, ensurepip; [ctypes.CDLL(name) for name in "$(LIBRARIES)".split()]' 2> /dev/null; \
	then true; \
	elif [ "$$(id -u)" = 0 ] && command -v apt-get > /dev/null; then $(APT_LINE); \
	else echo 'Missing system packages. As root, run:  $(APT_LINE)'; exit 1; fi
	$(PYTHON) -m venv $(VENV)
	@touch $@

# Every dependency at a known version with a known hash; a second run takes no time.
$(VENV)/.locked: constraints.txt $(VENV)/.made
	awk '/^[a-z]/ { keep = /^setuptools==/ } keep' constraints.txt > $(VENV)/build.txt
	$(BIN)/python -m pip install --quiet --require-hashes -r $(VENV)/build.txt
	$(BIN)/python -m pip install --quiet --require-hashes --no-build-isolation --use-pep517 -r constraints.txt
	@touch $@

$(VENV)/.installed: pyproject.toml $(VENV)/.locked
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation -e .
	@touch $@

lock: setup
	echo "setuptools>=77" | $(BIN)/uv pip compile --generate-hashes --universal --python-version 3.11 --fork-strategy fewest \
	  --all-extras --no-header --no-annotate --quiet --output-file constraints.txt pyproject.toml -

clean:
	rm -rf $(VENV) build *.egg-info
