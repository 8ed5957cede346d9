# Everything goes through .venv, made from exact versions; no command needs it activated.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Bytecode is kept, also where the shell says otherwise: pip compiles none, and hundreds of processes are started.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: install demo test test-benches test-bounds test-rivals test-browser check check-types check-rules page docs lock dist audit clean

install: $(VENV)/.installed

# In two parts: what the demo needs, and the rest.
$(VENV)/.demo: pyproject.toml tools/requirements.lock tools/install tools/install_torch
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Python 3.11 or newer is needed: make PYTHON=/path/to/python3"; exit 2; }
	@tools/install $(PYTHON) $(VENV) demo
	@touch $@

$(VENV)/.installed: $(VENV)/.demo
	@tools/install $(PYTHON) $(VENV) all
	@touch $@

demo: $(VENV)/.demo
	@rm -rf demo
	@PYTHONPATH=tools $(BIN)/python -m benches demo --out demo

# Two files of tests at a time, long ones first (tests/conftest.py), each with one thread of PyTorch: twice two threads
# wait for each other.
TESTS := OMP_NUM_THREADS=1 $(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder

# Rules of structure are in `check`.
test: install
	$(TESTS) --ignore tests/test_structure.py --ignore tests/benches

# Tests of what makes the results, whole benches among them, small: a quarter of the time of all.
test-benches: install
	$(TESTS) tests/benches

# Folders and files whose tests call compiled loops.
LOOPED := tests/machine tests/labels tests/artifacts tests/segmentation tests/training/test_geometric.py tests/training/test_mirror.py \
	tests/shards/test_sample_codec.py tests/loading/test_labels.py \
	tests/packing/test_two_projectors.py tests/networks/test_input.py tests/networks/test_labelling.py

# Compiled loops with every index checked: an access beyond an array is then an IndexError, not a damaged heap. Their
# machine code has folders of its own (bodyseg_data/machine/kernels.py).
test-bounds: install
	NUMBA_BOUNDSCHECK=1 $(TESTS) $(LOOPED)

# Tests of what benches compare with, packages that `make install` leaves out: loaders, decoders, networks.
test-rivals: install
	tools/install_rivals
	$(TESTS) tests/benches tests/networks

# Types take longest, by two processes: all else is checked beside them.
check: install
	@$(MAKE) --no-print-directory --jobs 2 check-types check-rules

check-types:
	$(BIN)/mypy

check-rules:
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pytest -q tests/test_structure.py

# Pages in a headless Chromium (apt-get install chromium): what they show, and what a slider changes.
test-browser: install
	PYTHONPATH=tools $(BIN)/python -m benches.browser.view --out browser

# Charts and page of results from the JSON in docs/results.
page: install
	tools/chart --in docs/results --out docs/results/charts --page $(patsubst %.in,%,$(wildcard docs/results/*.md.in))

# Documentation as a site, docs/_build/html/index.html; a minute of processor time.
docs: install
	$(BIN)/python -m sphinx --builder html --fail-on-warning --keep-going --quiet docs docs/_build/html

# Newest versions that pyproject.toml allows, as the next exact list; a new PyTorch is chosen by hand in the list.
lock:
	rm -rf $(VENV)/lock
	$(PYTHON) -m venv $(VENV)/lock
	tools/install_torch $(VENV)/lock/bin
	$(VENV)/lock/bin/pip install --quiet ".[dev]" setuptools
	{ head -n 1 tools/requirements.lock; $(VENV)/lock/bin/pip freeze --all --exclude pip --exclude bodyseg | sed -E 's/[+]cpu$$//; s/^backports.zstd==.*/&; python_version < "3.14"/; s/^embreex==.*/&; sys_platform != "linux" or platform_machine == "x86_64"/'; } > tools/requirements.new
	mv tools/requirements.new tools/requirements.lock

# Source distribution and wheel in dist/, checked as PyPI checks them.
dist: $(VENV)/release
	rm -rf dist build
	$(VENV)/release/bin/python -m build
	$(VENV)/release/bin/twine check --strict dist/*

# Known faults of the exact versions, from PyPI's own list: it asks pypi.org, also where pip has a mirror. Installs none.
audit: $(VENV)/release
	$(VENV)/release/bin/pip-audit --requirement tools/requirements.lock --no-deps --disable-pip --strict

$(VENV)/release: tools/requirements-release.lock
	$(PYTHON) -m venv --clear $@
	$@/bin/pip install --quiet --disable-pip-version-check -r $<

clean:
	rm -rf $(VENV) browser demo build dist docs/_build docs/generated *.egg-info
