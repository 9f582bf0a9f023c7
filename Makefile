# Everything works from a fresh clone with Python 3.11, 3.12 or 3.13, make and a network. Packages are installed inside this
# folder; compiled programs are cached in ~/.cache/softfin.

PYTHON ?= python3
UV := $(shell command -v uv 2>/dev/null)
ifeq ($(UV),)
UV := .tools/bin/uv
endif
export UV_PYTHON_DOWNLOADS ?= never
RUN := $(UV) run --frozen
# A file's tests on one worker, the longest files first.
PYTEST := $(RUN) pytest -n auto --dist loadfile --no-loadscope-reorder
# Behind the others and alone: these fail on a computer that is too busy.
REAL_TIME := $(RUN) pytest -m real_time
OUT ?= runs/demo
QUICK ?=
PYTHONS ?= $(PYTHON)

.PHONY: setup demo day test test-quick test-changed test-real-time test-long test-ray mutants wheel test-wheel test-lowest lint docs bench results results-quick figures clean

setup: .venv/.ready ## make the environment

.tools/bin/uv:
	$(PYTHON) -m venv .tools
	.tools/bin/python -m pip install --quiet uv

.venv/.ready: pyproject.toml uv.lock $(filter .tools/bin/uv,$(UV))
	$(UV) sync --frozen --python $(PYTHON) $(EXTRAS)
	touch $@

demo: setup ## collect, fit, find gaits, train, evaluate, report: some minutes on 2 cores, once set up; QUICK=1 for one minute
	$(RUN) softfin demo $(if $(QUICK),--quick) --out $(OUT) --overwrite

day: OUT = runs/day
day: setup ## a whole day at an emulated rig in some minutes: check, zero, collect, fit, train, evaluate, run
	$(RUN) python examples/rig_day.py --quick --out $(OUT)

test: setup ## all tests
	$(PYTEST) -m "not real_time"
	$(REAL_TIME)

test-quick: setup ## the tests that take a few seconds at most
	$(PYTEST) -m "not slow and not real_time"

test-changed: setup ## the files of tests that import, or read, what has changed since they last passed
	$(RUN) python tools/changed.py

test-real-time: setup ## the tests that fail on a computer that is too busy
	$(REAL_TIME)

test-long: setup ## all tests, with more cases of each kind and twenty minutes of faults in real time
	SOFTFIN_LONG=1 $(PYTEST) -m "not real_time"
	SOFTFIN_LONG=1 $(REAL_TIME)

test-ray: setup ## the tests that need Ray, in a network of their own; installs the extra: 76 MB to fetch, 201 MB
	$(RUN) --extra ray pytest -rs tests/stages/test_ray_training.py

mutants: setup ## change the code in 200 places, one at a time, and list what no test notices; NUMBER=60 SEED=1 MODULES=rig
	$(RUN) python tools/mutants.py $(NUMBER) $(if $(SEED),--seed $(SEED)) $(if $(MODULES),--modules $(MODULES)) \
		$(if $(REPEAT),--repeat $(REPEAT))

wheel: $(filter .tools/bin/uv,$(UV)) ## wheel and source distribution, in dist/, and the versions that were tested, for robots
	$(UV) build --quiet --out-dir dist
	$(UV) export --frozen --quiet --no-dev --no-emit-project --no-hashes --no-annotate --no-header --extra ros2 \
		--output-file dist/constraints.txt

test-wheel: setup wheel ## the wheel in empty environments outside this folder; PYTHONS="python3.11 python3.13"
	UV="$(UV)" SOFTFIN_WHEEL=dist SOFTFIN_PYTHONS="$(PYTHONS)" $(RUN) pytest -rs tests/test_wheel.py

test-lowest: setup ## a whole day at an emulated rig with the oldest packages that pyproject.toml allows
	$(UV) venv --quiet --clear --python $(PYTHON) build/lowest
	$(UV) pip install --quiet --python build/lowest/bin/python --resolution lowest-direct \
		".[emulation,learn,onnx,ros2,serial]"
	build/lowest/bin/python examples/rig_day.py --quick --out build/lowest/day

lint: setup ## style, types, the order of imports, the words, the size and shape of the code
	$(RUN) ruff check .
	$(RUN) ruff format --check .
	$(RUN) mypy
	$(RUN) lint-imports
	$(RUN) python tools/words.py
	$(RUN) python tools/style.py

docs: setup ## the site of the documentation, in build/docs; warnings are errors; DEMO=DIR goes on with a tiny demo there
	$(if $(DEMO),SOFTFIN_DEMO="$(abspath $(DEMO))") $(RUN) --group docs sphinx-build --jobs 2 --fail-on-warning --keep-going --quiet docs build/docs

bench: setup ## speed and memory, as JSON; EXTRAS="--extra sb3" brings the peer, 5 GB
	$(UV) sync --frozen $(EXTRAS)
	$(RUN) $(EXTRAS) python -m benchmarks

results: setup ## rerun the figures of README and docs: hours; MINUTES=60 PART="surrogates choices/13" SINCE=COMMIT
	$(RUN) $(EXTRAS) python -m results $(PART) $(if $(MINUTES),--minutes $(MINUTES)) $(if $(SINCE),--since $(SINCE))
	$(RUN) python -m results --write

results-quick: setup ## rerun one seed of every part in about an hour and a half and compare it with the figures, before a release; SEED=15
	$(RUN) $(EXTRAS) python -m results --quick $(if $(SEED),--seed $(SEED)) $(PART)

figures: setup ## write the figures of results/, and their age, into README and docs
	$(RUN) python -m results --write

clean:
	rm -rf .venv .tools build dist .mypy_cache .ruff_cache .pytest_cache
