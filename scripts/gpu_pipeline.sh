#!/usr/bin/env bash
# What only a CUDA machine can show. bash scripts/gpu_pipeline.sh bench | data [--smoke]
# bench: seconds of a step by stage, device and precision, and pairs a second of the direct sum; under ten minutes.
#   Writes $OUT/bench_step_cuda.json and .md (OUT: default out/gpu).
# data: harvest the runs of configs/datagen/default.toml on the device, select, and label on the CPU's cores. Writes $OUT/data.
# --smoke: small cases on the CPU. MPIRUN: a launcher such as "mpirun -n 16", for the labels.
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

data() {
    local config=configs/datagen/default.toml device=cuda
    if [[ "${1:-}" == "--smoke" ]]; then
        config=configs/datagen/smoke.toml device=torch
    fi
    time "$PYTHON" -m datagen harvest "$config" -o "$OUT/data" --device "$device"
    time "$PYTHON" -m datagen select "$config" -o "$OUT/data"
    # shellcheck disable=SC2086  # a launcher and its arguments
    time OMP_NUM_THREADS=1 ${MPIRUN:-} "$PYTHON" -m datagen label "$config" -o "$OUT/data"
}

case "${1:-}" in
    bench) bench "${2:-}" ;;
    data) data "${2:-}" ;;
    *)
        sed -n 2,8p "$0" >&2
        exit 2
        ;;
esac
