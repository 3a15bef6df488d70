#!/usr/bin/env bash
# What only a CUDA machine can show, in stages of under ten minutes that go on where they were stopped.
#
#   bash scripts/gpu_pipeline.sh STAGE [--smoke]      stages in order: bench data labels train merge evaluate vesnet; all: one after another
#
# bench: seconds of a step by stage, device and precision, and pairs a second of the direct sum: $OUT/bench_step_cuda.json, .md.
# data: harvest the runs of configs/datagen/default.toml on the device, and select. labels: label them on the CPU's cores, with the flow over
#   two time steps: $OUT/data. train: every map and mode (configs/train/gpu_*.toml), for nine minutes, then again the same: $OUT/runs.
# merge, evaluate: $OUT/weights, $OUT/evaluate. vesnet: a step of VesNet beside split on the device: $OUT/bench_vesnet.json.
# OUT: default out/gpu. --smoke: small cases on the CPU, all stages in a few minutes. MPIRUN: a launcher such as "mpirun -n 16", for labels.
# PYTHON: the interpreter, with this package's dependencies installed, cufinufft and a CUDA build of PyTorch among them.
set -euo pipefail
cd "$(dirname "$0")/.."
export PYTHONPATH="$PWD${PYTHONPATH:+:$PYTHONPATH}"
PYTHON="${PYTHON:-python3}"
OUT="${OUT:-out/gpu}"
mkdir -p "$OUT"

bench() {
    if [[ "${1:-}" == "--smoke" ]]; then
        "$PYTHON" scripts/bench_step.py --smoke --devices cpu torch --json "$OUT/bench_step_smoke.json" | tee "$OUT/bench_step_smoke.md"
        return
    fi
    "$PYTHON" -c 'import torch; assert torch.cuda.is_available(), "no CUDA device that PyTorch can use"; print(torch.cuda.get_device_name())'
    {
        "$PYTHON" scripts/bench_step.py --devices cuda --dtypes float64 float32 --far-fields direct ewald --counts 48 504 2000 8000 \
            --limit 60 --json "$OUT/bench_step_cuda.json"
        "$PYTHON" scripts/bench_step.py --devices cuda --dtypes float64 float32 --points 64 128 --counts 504 2000 \
            --limit 60 --json "$OUT/bench_step_cuda_n.json"
    } | tee "$OUT/bench_step_cuda.md"
}

smoke() { [[ "${1:-}" == "--smoke" ]]; }

config_of() { if smoke "${1:-}"; then echo configs/datagen/smoke.toml; else echo configs/datagen/default.toml; fi; }

data() {
    local device=cuda
    if smoke "${1:-}"; then device=torch; fi
    "$PYTHON" -m datagen harvest "$(config_of "${1:-}")" -o "$OUT/data" --device "$device"
    "$PYTHON" -m datagen select "$(config_of "${1:-}")" -o "$OUT/data"
}

labels() {
    # shellcheck disable=SC2086  # a launcher and its arguments
    local label="${MPIRUN:-} $PYTHON -m datagen label $(config_of "${1:-}") -o $OUT/data" dt
    export OMP_NUM_THREADS=1
    $label
    for dt in 1e-5 1e-4; do
        $label --name "flow$dt" --maps relax --set label.relaxation=converged --set label.operator_points=96 --set "label.dt=$dt"
    done
}

train() {
    local pairs=(--data "$OUT/data/pairs.h5" --data "$OUT/data/pairs-flow1e-5.h5" --data "$OUT/data/pairs-flow1e-4.h5")
    export OMP_NUM_THREADS=1
    if smoke "${1:-}"; then
        local config=(--config configs/train/smoke.toml)
        "$PYTHON" -m surrogate train --all --quiet "${pairs[@]}" -o "$OUT/runs/mlp" "${config[@]}"
        "$PYTHON" -m surrogate train --all --quiet "${pairs[@]}" -o "$OUT/runs/hybrid" "${config[@]}" --target residual
        "$PYTHON" -m surrogate train --all --quiet "${pairs[@]}" -o "$OUT/runs/ivnet" "${config[@]}" --arch ivnet --grouped
        return
    fi
    # checkpoints are kept: status 124 is the end of the time, not of the training
    timeout --signal TERM 540 bash -ec '
        python=$0 out=$1
        shift
        for kind in mlp hybrid ivnet; do
            "$python" -m surrogate train --all --grouped --device cuda --quiet "$@" -o "$out/runs/$kind" --config "configs/train/gpu_$kind.toml"
        done' "$PYTHON" "$OUT" "${pairs[@]}"
}

merge() {
    "$PYTHON" -m surrogate merge "$OUT/runs" -o "$OUT/weights"
}

evaluate() {
    local few=()
    if smoke "${1:-}"; then few=(--smoke); fi
    "$PYTHON" -m surrogate evaluate --weights "$OUT/weights" --data "$OUT/data/pairs.h5" --flow "$OUT/data/pairs-flow1e-5.h5" \
        --flow "$OUT/data/pairs-flow1e-4.h5" -o "$OUT/evaluate" "${few[@]}"
}

vesnet() {
    local options=(--solvers split vesnet:hybrid vesnet:mlp vesnet:ivnet --weights "$OUT/weights" --devices cuda --dtypes float32 --counts 48 504 2000)
    if smoke "${1:-}"; then # networks of a few steps of training are stopped by the guard: the shipped ones
        options=(--solvers split vesnet:hybrid vesnet:mlp --counts 4 --repeat 1)
    fi
    "$PYTHON" scripts/bench_step.py "${options[@]}" --limit 120 --json "$OUT/bench_vesnet.json" | tee "$OUT/bench_vesnet.md"
}

stage="${1:-}"
case "$stage" in
    bench | data | labels | train | merge | evaluate | vesnet) "$stage" "${2:-}" ;;
    all) for stage in bench data labels train merge evaluate vesnet; do "$stage" "${2:-}"; done ;;
    *)
        sed -n 2,14p "$0" >&2
        exit 2
        ;;
esac
