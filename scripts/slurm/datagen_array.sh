#!/bin/bash
# A stage of a data set as a job array: P jobs of one core each, each makes every P-th shard. They need no MPI and wait for nobody.
#
#   harvest=$(sbatch --parsable --array=1-32 scripts/slurm/datagen_array.sh harvest configs/datagen/default.toml data/default)
#   sbatch --dependency=afterok:$harvest --wrap ".venv/bin/python -m datagen harvest configs/datagen/default.toml -o data/default &&
#                                                .venv/bin/python -m datagen select  configs/datagen/default.toml -o data/default"
#   label=$(sbatch --parsable --array=1-32 scripts/slurm/datagen_array.sh label configs/datagen/default.toml data/default)
#   sbatch --dependency=afterok:$label   --wrap ".venv/bin/python -m datagen label   configs/datagen/default.toml -o data/default"
#
# The stage without --part makes what is missing, if anything is, and joins the parts. Jobs that were stopped, failed or killed: submit the
# same again, only missing shards are made; --array=3,7 with PARTS=32 in the environment for those parts alone, or another number of parts.
# Further arguments go to the stage: --set label.points=64, --modes 0-4, --device cuda (then also sbatch --gpus=1).

#SBATCH --job-name=datagen
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=1
#SBATCH --mem=4G
#SBATCH --time=12:00:00
#SBATCH --signal=B:TERM@60
#SBATCH --output=%x-%A_%a.out

set -euo pipefail

if (($# < 3)); then
    echo "usage: sbatch --array=1-P $0 harvest|label CONFIG DATA [options]" >&2
    exit 2
fi
stage=$1 config=$2 data=$3
shift 3

k=${SLURM_ARRAY_TASK_ID:?submit it with sbatch --array=1-P}
if [[ -z ${PARTS:-} ]] && ((SLURM_ARRAY_TASK_MIN != 1 || SLURM_ARRAY_TASK_COUNT != SLURM_ARRAY_TASK_MAX)); then
    echo "this array is not 1-P: say of how many parts these are some, PARTS=32 sbatch --array=3,7 ..." >&2
    exit 2
fi
parts=${PARTS:-$SLURM_ARRAY_TASK_MAX}

cd "${SLURM_SUBMIT_DIR:-.}"
export OMP_NUM_THREADS=1
# exec: the signal that comes a minute before the time limit reaches Python, which gives up its task and exits with 4
exec "${PYTHON:-.venv/bin/python}" -m datagen "$stage" "$config" -o "$data" --part "$k/$parts" --quiet "$@"
