"""A calibrated law, with its effects, drives vehicles in SUMO.

Examples:
  # the vehicles of type car; SUMO's steps must be those of the run
  nnode drive run=RUN sumo=SCENARIO.sumocfg vehicles=car
  # SUMO makes the run's steps, in a process of its own
  nnode drive run=RUN sumo=SCENARIO.sumocfg vehicles=car steps=run program=traci
  # a law without a speed on an empty road: who is 100 m away counts as nobody
  nnode drive run=RUN sumo=SCENARIO.sumocfg vehicles=[car,truck] far=100

Results: fcd.xml.gz, all vehicles' trajectories, which data=sumo reads; drive.json, how many were
driven, how fast, collisions and teleports. docs/exchange.md says what SUMO is told and asked.
"""

from __future__ import annotations

from nnode.app.cli.run import run
from nnode.app.drive import drive_scenario


def main() -> None:
    """Run this command on the options of the command line."""
    run("drive", drive_scenario)
