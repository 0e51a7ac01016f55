"""Fly a campaign in a child that is killed at a random instant, repeatedly, until one child completes.

    python killing.py CAMPAIGN DIR KILLS SEED LONGEST_S

The parent loads everything before it forks, so that a child begins to fly at once. Prints the number of kills.
"""

from __future__ import annotations

import os
import random
import signal
import sys
import time
from pathlib import Path

import maxq
from maxq.sim.campaign.own_kernels import load_kernels
from maxq.sim.campaign.runner import run_campaign


def main(file: str, folder: str, kills: int, seed: int, longest_s: float) -> int:
    campaign = maxq.load(file)
    load_kernels(campaign)
    chance = random.Random(seed)
    done = 0
    while True:
        child = os.fork()
        if child == 0:
            run_campaign(campaign, Path(folder), workers=2)
            os._exit(0)
        if done < kills:
            time.sleep(chance.uniform(0.0, longest_s))
            os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        if os.WIFEXITED(status) and (done >= kills or os.WEXITSTATUS(status) != 0):
            print(done)
            return os.WEXITSTATUS(status)
        done += os.WIFSIGNALED(status)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]), float(sys.argv[5])))
