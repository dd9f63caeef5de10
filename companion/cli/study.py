"""The command ``companion study``: one subcommand per experiment."""

import click

from companion.cli.learned import train
from companion.cli.study_beams import beams
from companion.cli.study_compass import compass
from companion.cli.study_deepsense import deepsense
from companion.cli.study_fleet import fleet
from companion.cli.study_link import link
from companion.cli.study_paper import dt, paper
from companion.cli.study_prediction import prediction


@click.group()
def study() -> None:
    """Run an experiment; write figures and tables as an HTML page, and the numbers as JSON.

    Example: companion study prediction flight.tlog --center 5:1 --out report
    """


for command in (prediction, beams, compass, link, paper, dt, deepsense, fleet, train):
    study.add_command(command)
