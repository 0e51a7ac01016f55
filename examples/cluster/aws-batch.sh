#!/bin/bash
# The command of an AWS Batch array job whose size is MAXQ_SHARDS (a variable in the environment of the job definition).
# MAXQ_OUT is a folder that all jobs share (EFS, or FSx). Batch counts from 0, simrun from 1.
# Afterwards, in a job that depends on the array: simrun merge "$MAXQ_OUT"/part-* --out runs/ksr3
# A job that lost its Spot instance is attempted again (retryStrategy), and resumes its shard.
set -eu
shard=$((AWS_BATCH_JOB_ARRAY_INDEX + 1))
exec simrun campaign "${1:-campaigns/ksr3}" --shard "$shard/$MAXQ_SHARDS" --out "$MAXQ_OUT/part-$shard"
