#!/usr/bin/env bash
# A small set of weights for another reduced area, from nothing to a folder that scenes can use, in some minutes on two cores.
#
#   bash scripts/train_small.sh 0.8 out/rv0.8
#   .venv/bin/python -m biem run configs/scenes/vesnet_pair.toml --set vesicles.reduced_area=0.8 --weights out/rv0.8/weights
#
# Corrections to exact maps (hybrid), which need few shapes. The same command again goes on where it was stopped. Further arguments go to the
# training: --set training.samples=1000000. PROCESSES: default all cores. PYTHON, MPIRUN: default those of .venv.
set -euo pipefail
if (($# < 2)); then
    echo "usage: bash $0 REDUCED_AREA FOLDER [training options]" >&2
    exit 2
fi
area=$1 folder=$2
shift 2
cd "$(dirname "$0")/.."
python="${PYTHON:-.venv/bin/python}"
run=("${MPIRUN:-.venv/bin/mpirun}" -n "${PROCESSES:-$(nproc)}" "$python" -m)
export OMP_NUM_THREADS=1
config=(configs/datagen/small.toml -o "$folder/data" --set "shapes.reduced_area=$area")
"${run[@]}" datagen make "${config[@]}"
"${run[@]}" datagen label "${config[@]}" --name flow1e-5 --maps relax --set label.relaxation=converged --set label.operator_points=96
"${run[@]}" surrogate train --all --data "$folder/data/pairs.h5" --data "$folder/data/pairs-flow1e-5.h5" -o "$folder/runs" \
    --config configs/train/small.toml "$@"
"$python" -m surrogate merge "$folder/runs" -o "$folder/weights"
