#!/bin/bash
# Every map and mode as a job array: P jobs of one core each, each trains its share of the networks, one after another.
#
#   job=$(sbatch --parsable --array=1-20 scripts/slurm/train_array.sh configs/train/ivnet.toml data/default out/train/ivnet)
#   sbatch --dependency=afterok:$job --wrap ".venv/bin/python -m surrogate merge out/train -o out/weights"
#
# Trains on DATA/pairs.h5 and, for relaxation, on all DATA/pairs-flow*.h5. Jobs that were stopped, failed or killed: submit the same again, each
# network goes on from its last checkpoint. Further arguments go to the training: --set training.samples=1000000, --device cuda.

#SBATCH --job-name=train
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=1
#SBATCH --mem=8G
#SBATCH --time=12:00:00
#SBATCH --signal=B:TERM@60
#SBATCH --output=%x-%A_%a.out

set -euo pipefail

if (($# < 3)); then
    echo "usage: sbatch --array=1-P $0 CONFIG DATA RUNS [options]" >&2
    exit 2
fi
config=$1 data=$2 runs=$3
shift 3
k=${SLURM_ARRAY_TASK_ID:?submit it with sbatch --array=1-P}
if [[ -z ${PARTS:-} ]] && ((SLURM_ARRAY_TASK_MIN != 1 || SLURM_ARRAY_TASK_COUNT != SLURM_ARRAY_TASK_MAX)); then
    echo "this array is not 1-P: say of how many parts these are some, PARTS=20 sbatch --array=3,7 ..." >&2
    exit 2
fi

cd "${SLURM_SUBMIT_DIR:-.}"
files=(--data "$data/pairs.h5")
for flow in "$data"/pairs-flow*.h5; do
    [[ -e $flow ]] && files+=(--data "$flow")
done
export OMP_NUM_THREADS=1
exec "${PYTHON:-.venv/bin/python}" -m surrogate train --all "${files[@]}" -o "$runs" --config "$config" --quiet \
    --part "$k/${PARTS:-$SLURM_ARRAY_TASK_MAX}" "$@"
