# make smoke: every stage of the GPU pipeline on small cases, on the CPU.
# make demo: set up everything, run two vesicles in shear, by every solver, and 100 in a parabolic flow, make a small data set: in out/demo.
# make dataset: harvest and select the shapes of configs/datagen/default.toml into data/default, or go on with that.
# make docs: the documentation as a site that needs no network, in out/site.
# make test: set up everything, run the tests, on as many processes as there are cores.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
DEV := .venv/.dev
QUICKLY := --quiet --disable-pip-version-check --no-compile  # compiling what is never loaded takes longer than all else
export OMP_WAIT_POLICY = PASSIVE
unexport PYTHONDONTWRITEBYTECODE  # where it is set, as images do, each process would compile all that it loads

.PHONY: setup demo dataset docs smoke test lint clean
setup: $(READY)

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed, this is " + sys.version)'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install $(QUICKLY) -c constraints.txt torch
	$(BIN)/python -m pip install $(QUICKLY) -c constraints.txt -e '.[fast,mpi]'
	touch $(READY)

$(DEV): $(READY)
	$(BIN)/python -m pip install $(QUICKLY) -c constraints.txt -e '.[dev,docs,fast,mpi]'
	touch $(DEV)

demo: $(READY)
	$(BIN)/python -m biem run configs/scenes/shear_pair.toml -o out/demo/shear_pair.h5 --force
	$(BIN)/python -m biem plot out/demo/shear_pair.h5 -o out/demo/shear_pair
	$(BIN)/python -m biem run configs/scenes/poiseuille_100.toml -o out/demo/poiseuille_100.h5 --force
	$(BIN)/python -m biem plot out/demo/poiseuille_100.h5 -o out/demo/poiseuille_100
	$(BIN)/python scripts/compare.py configs/scenes/vesnet_pair.toml -o out/demo/compare --set "time.horizon=10 t_gamma"
	$(BIN)/python -m datagen make configs/datagen/smoke.toml -o out/demo/data

dataset: $(READY)
	OMP_NUM_THREADS=1 $(BIN)/mpirun -n $$(nproc) $(BIN)/python -m datagen harvest configs/datagen/default.toml -o data/default
	$(BIN)/python -m datagen select configs/datagen/default.toml -o data/default

smoke: $(READY)
	PYTHON=$(BIN)/python OUT=out/smoke bash scripts/gpu_pipeline.sh all --smoke

docs: $(DEV)
	PYTHONPATH=scripts NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

test: $(DEV)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder

lint: $(DEV)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

clean:
	rm -rf .venv out
