"""Control vehicles in SUMO by a calibrated law with its effects.

Examples:
  # the vehicles of type car; SUMO's steps must be those of the run
  nnode drive run=RUN sumo=SCENARIO.sumocfg vehicles=car
  # SUMO uses the run's steps, in a separate process
  nnode drive run=RUN sumo=SCENARIO.sumocfg vehicles=car steps=run program=traci
  # a law without a speed on an empty road: vehicles beyond 100 m are ignored
  nnode drive run=RUN sumo=SCENARIO.sumocfg vehicles=[car,truck] far=100

Results: fcd.xml.gz, all vehicles' trajectories, which data=sumo reads; drive.json, the number and
speed of controlled vehicles, collisions and teleports. docs/exchange.md explains the interface.
"""

from __future__ import annotations

from nnode.app.cli.run import run
from nnode.app.drive import drive_scenario


def main() -> None:
    """Run this command on the options of the command line."""
    run("drive", drive_scenario)
