#!/usr/bin/env bash
#SBATCH --job-name=fric-sweep
#SBATCH --array=0-63
#SBATCH --cpus-per-task=1
#SBATCH --mem=1G
#SBATCH --time=02:00:00
#SBATCH --requeue
#
# Runs a sweep as an array of 64 tasks:
#
#   fric sweep servo.fric hunting --vary … --plan sweep.fricjob
#   array=$(sbatch --parsable slurm.sh sweep.fricjob units)
#   sbatch --dependency=afterok:$array --wrap 'fric sweep --join sweep.fricjob units/*.fricunit --out sweep.csv'
#
# Another number of tasks: sbatch --array=0-255 --export=ALL,FRIC_UNITS=256 slurm.sh …
# A task may be killed, requeued and repeated: a unit is written whole or not at all, and one that is there stays.
# Tasks that failed, alone: sbatch --array=3,17 slurm.sh sweep.fricjob units
set -euo pipefail
plan=${1:?slurm.sh PLAN [FOLDER]: the file that fric sweep --plan has written is missing}
folder=${2:-units}
units=${FRIC_UNITS:-64}
exec fric sweep --unit "%j/$units" "$plan" --out "$folder/$SLURM_ARRAY_TASK_ID.fricunit" \
  --threads "${SLURM_CPUS_PER_TASK:-1}" --quiet
