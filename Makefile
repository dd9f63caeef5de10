# Two commands on a fresh machine: `make demo`, `make test`. Each makes .venv by itself, and
# again when a lock, pyproject.toml or the place of this directory has changed.
# For GNU make 3.81 or later and any POSIX shell. PYTHON=... chooses the interpreter.

SHELL = /bin/sh
BIN = .venv/bin
PIP = $(BIN)/python -m pip --disable-pip-version-check install --quiet --require-hashes
PYTEST = $(BIN)/python -m pytest
UV = uv

# The matrices are small: threads in BLAS cost more than they give, and make timings vary.
OPENBLAS_NUM_THREADS = 1
export OPENBLAS_NUM_THREADS

# Where this is set, each worker and each of some hundred processes that tests start compiles all
# that it imports anew: together as long as the tests themselves.
unexport PYTHONDONTWRITEBYTECODE

# Tests of pure rooms on two workers; those that start services share one, one after the other.
WORKERS = -n 2 --dist loadgroup

.PHONY: demo test test-all check site bench soak fuzz messages format lock clean FORCE

demo: .venv/.runtime
	$(BIN)/companion demo

# What must be green before anything lands: at most five minutes on two quiet cores. Tests marked
# `full` are left out. Warnings are errors: pyproject.toml says so to pytest, for every run.
test: .venv/.dev
	$(PYTEST) -q $(WORKERS) -m "not full and not benchmark and not soak"

# Every test, and more examples of each property.
test-all: .venv/.dev
	HYPOTHESIS_PROFILE=full $(PYTEST) -q $(WORKERS)

# The formatter, the linter, the types, the rules of the house and the container's files. The
# site of the documents is built, and any warning ends it. The rest of the tests is not run a second time here: `make test` has warnings as errors already.
check: .venv/.dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy --strict companion sitl_replay
	$(BIN)/python tests/dead_code.py
	$(BIN)/lint-imports
	$(BIN)/hadolint Dockerfile
	$(BIN)/check-jsonschema --builtin-schema vendor.compose-spec docker-compose.yml
	@if docker compose version >/dev/null 2>&1; then docker compose --profile demo config --quiet; \
	else echo "no docker compose here: docker-compose.yml is held against its schema alone"; fi
	$(BIN)/python docs/make_site.py
	$(PYTEST) -q tests/test_house.py tests/test_docs.py

# The documents as pages that are read without internet: build/site/index.html.
site: .venv/.dev
	$(BIN)/python docs/make_site.py

# Tests marked `benchmark` and `soak`, which `make test` leaves out. No such test: status 5.
# The figures are kept in build/bench.json (or BENCH_JSON), and compared with those there before.
bench: .venv/.dev
	$(PYTEST) -q -s -m benchmark

soak: .venv/.dev
	$(PYTEST) -q -s -m soak --timeout=0

# What fails is left in build/fuzz/TARGET/crash-…; what reaches new code goes into the corpus.
FUZZ_SECONDS = 600
fuzz: .venv/.dev
	@for target in framing fold recovery settings http; do \
	    $(BIN)/python tests/fuzzing/run.py $$target $(FUZZ_SECONDS) --keep || exit 1; done

# Every error and notice that the tests cause, in docs/messages.md.
messages: .venv/.dev
	rm -f build/texts.jsonl && mkdir -p build
	COLLECT_TEXTS=build/texts.jsonl $(PYTEST) -q $(WORKERS) -m "not full and not benchmark and not soak"
	$(BIN)/python docs/list_texts.py --collected build/texts.jsonl

format: .venv/.dev
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

# Recordings are left alone.
clean:
	rm -rf .venv build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis \
	    .import_linter_cache .coverage htmlcov *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# --- the environment ----------------------------------------------------------------------------

# The stamp holds the directory that .venv was made in: a moved or copied one is made again.
ifneq ($(shell test -x $(BIN)/python && cat .venv/.runtime 2>/dev/null),$(CURDIR))
.venv/.runtime: FORCE
endif

.venv/.runtime: requirements.lock pyproject.toml
	@$(find_python); \
	echo "making .venv with $$($$python -V) (once; one to four minutes)"; \
	"$$python" -m venv --clear .venv
	@$(PIP) -r requirements.lock
	@$(PIP:--require-hashes=) --no-deps --no-build-isolation --editable .
	@printf '%s\n' "$(CURDIR)" > $@

.venv/.dev: .venv/.runtime requirements-dev.lock
	@echo "adding the tools for tests to .venv"
	@$(PIP) -r requirements-dev.lock
	@touch $@

# Sets $$python to the first interpreter that will do, or says in one line what is missing.
define find_python
python=; old=; bare=; \
for p in $(if $(PYTHON),'$(PYTHON)',python3.13 python3.12 python3.11 python3); do \
    v=$$("$$p" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null) || continue; \
    if ! "$$p" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then old="$$p is $$v"; \
    elif ! "$$p" -c 'import venv, ensurepip' 2>/dev/null; then bare="$$p"; \
    else python="$$p"; break; fi; \
done; \
if [ -z "$$python" ]; then \
    if [ -n "$$bare" ]; then echo "$$bare has no venv module: install it" \
        "(Debian, Ubuntu: apt install python3-venv)"; \
    elif [ -n "$$old" ]; then echo "Python 3.11 or later is needed, and $$old:" \
        "install a newer one, or name it with PYTHON=..."; \
    else echo "Python 3.11 or later is needed, and" \
        "$(if $(PYTHON),$(PYTHON) is not one,there is no python3): install one, or name it" \
        "with PYTHON=..."; \
    fi >&2; \
    exit 1; \
fi
endef

# Every version and hash, without the address of any registry.
COMPILE = $(UV) pip compile pyproject.toml --universal --python-version 3.11 \
    --fork-strategy fewest --generate-hashes --no-header --no-annotate --quiet $(UPGRADE)

# Keeps the versions that still fit; `make lock UPGRADE=--upgrade` takes the newest.
lock:
	@command -v $(UV) >/dev/null || { echo "make lock needs uv; name it with UV=..." >&2; exit 1; }
	$(COMPILE) --group build --output-file requirements.lock
	$(COMPILE) --group build --extra dev --constraint requirements.lock \
	    --output-file requirements-dev.lock
	@! grep -n '://' requirements.lock requirements-dev.lock
