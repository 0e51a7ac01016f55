#!/bin/bash
# A campaign as a Slurm array of 32 shards, and a job that merges them:
#   job=$(sbatch --parsable slurm.sh campaigns/ksr3 /scratch/ksr3)
#   sbatch --dependency=afterok:"$job" --wrap 'simrun merge /scratch/ksr3/part-* --out runs/ksr3'
# A shard that was requeued or submitted again (sbatch --array=7 slurm.sh ...) resumes where it stopped.
#SBATCH --array=1-32
#SBATCH --cpus-per-task=8
#SBATCH --time=02:00:00
#SBATCH --requeue
set -eu
shards=32  # the size of --array above; not SLURM_ARRAY_TASK_COUNT, which is 1 when one shard is submitted again
exec simrun campaign "$1" --shard "$SLURM_ARRAY_TASK_ID/$shards" --out "$2/part-$SLURM_ARRAY_TASK_ID" \
    --workers "${SLURM_CPUS_PER_TASK:-1}"
