#!/bin/bash
# A data set by one job on several nodes: tasks are dealt out one by one to all ranks. The data folder must be on a disk that all nodes see.
#
#   sbatch scripts/slurm/datagen_mpi.sh make configs/datagen/default.toml -o data/default
#   sbatch --nodes=8 --time=24:00:00 scripts/slurm/datagen_mpi.sh label configs/datagen/default.toml -o data/default --modes 0-4
#
# A job that was stopped, failed or killed: submit the same again, only missing shards are made.
#
# srun must speak to the MPI that mpi4py was built for: `srun --mpi=list` shows what it can, MPI_TYPE=pmix chooses it. The MPICH from PyPI
# speaks pmi2. Where they do not understand each other every rank says "mpi4py's MPI sees one" and nothing is made: LAUNCH=mpirun then
# takes the launcher beside Python, which finds the nodes of the job by itself.

#SBATCH --job-name=datagen
#SBATCH --nodes=2
#SBATCH --ntasks-per-node=32
#SBATCH --cpus-per-task=1
#SBATCH --mem-per-cpu=2G
#SBATCH --time=12:00:00
#SBATCH --signal=TERM@60
#SBATCH --output=%x-%j.out

set -euo pipefail

if (($# < 2)); then
    echo "usage: sbatch $0 make|harvest|label CONFIG [-o DATA] [options]" >&2
    exit 2
fi

cd "${SLURM_SUBMIT_DIR:-.}"
python=${PYTHON:-.venv/bin/python}
export OMP_NUM_THREADS=1

# one core a rank; a rank that dies takes the others with it, for the first rank would wait for its result
if [[ ${LAUNCH:-srun} == mpirun ]]; then
    exec "$(dirname "$python")/mpirun" -n "${SLURM_NTASKS:?submit it with sbatch}" "$python" -m datagen "$@"
fi
exec srun --mpi="${MPI_TYPE:-pmi2}" --cpu-bind=cores --kill-on-bad-exit=1 "$python" -m datagen "$@"
