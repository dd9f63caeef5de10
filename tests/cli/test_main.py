"""Commands: help with an example, errors in one line, ``design`` with its fields."""

import json
import socket
from typing import Any

import pytest
from click.testing import CliRunner

from companion.cli.main import main

COMMANDS = sorted(main.commands)


def run(*arguments: str) -> Any:
    """Run a command like the console script."""
    return CliRunner().invoke(main, arguments, standalone_mode=True)


def test_commands_match_the_documentation() -> None:
    documented = "calibrate demo drive fleet run replay check design export recover study weights"
    assert set(COMMANDS) == set(documented.split())


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_an_example(command: str) -> None:
    answer = run(command, "--help")
    assert answer.exit_code == 0
    assert f"Example: companion {command}" in answer.stdout


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["design", "--dt", "x"], "'x' is not a list of numbers"),
        (["design", "--dt", "-1"], "positive number of seconds"),
        (["design", "--dt", "nan"], "positive number of seconds"),
        (["design", "--dt", "0.1", "--alpha", "2"], "alpha is 2.0, allowed: 0 to 1, both excluded"),
        (["run"], "center.source is not set; give --center"),
        (["run", "--center", "5:1"], "links.urls is empty; give --link"),
        (["run", "--center", "5"], "'5' is not SYSID:COMPID"),
        (["run", "--center", "5:1", "--link", "foo"], "'foo' is not a link; give one of udpin:"),
        (
            ["run", "--center", "5:1", "--link", "udpin:127.0.0.1:0", "--listen", "0.0.0.0:0"],
            "--insecure",
        ),
        (["replay"], "Missing argument"),
        (["nothing"], "No such command"),
        (["demo", "--port", "99999"], "99999"),
    ],
)
def test_command_error_is_one_line(arguments: list[str], says: str) -> None:
    answer = run(*arguments)
    assert answer.exit_code not in (0, None)
    assert answer.stdout == ""
    assert len(answer.stderr.splitlines()) == 1
    assert answer.stderr.startswith("companion: ")
    assert says in answer.stderr


def test_design_matches_the_paper() -> None:
    common = ["design", "--dt", "0.15", "--alpha", "0.5", "--feedthrough", "0.5", "--json"]
    (row,) = json.loads(run(*common).stdout)
    assert row["L"] == pytest.approx(0.30)
    assert row["Q"] == pytest.approx(0.70)
    assert row["mu"] == 0
    assert row["dt_limit_s"] is None
    assert set(row) == {
        *("dt_s", "model", "alpha", "feedthrough_s", "L", "Q", "mu", "gamma"),
        *("peak_gain", "feasible", "dt_limit_s", "method", "residual"),
    }
    for mu_max, limit_s in ((0.05, 0.8873), (0.25, 1.0), (1.0, 1.2906)):
        (row,) = json.loads(run(*common, "--mu-max", str(mu_max)).stdout)
        assert row["dt_limit_s"] == pytest.approx(limit_s, abs=5e-5)
        assert row["feasible"]
    rows = json.loads(
        run(
            "design",
            "--dt",
            "0.88,0.89",
            "--alpha",
            "0.5",
            "--feedthrough",
            "0.5",
            "--mu-max",
            "0.05",
            "--json",
        ).stdout
    )
    assert [row["feasible"] for row in rows] == [True, False]


def test_lmi_design_agrees_with_the_closed_form() -> None:
    arguments = ["design", "--dt", "0.9", "--alpha", "0.5", "--feedthrough", "0.3", "--json"]
    (closed,) = json.loads(run(*arguments).stdout)
    (solved,) = json.loads(run(*arguments, "--method", "lmi").stdout)
    assert solved["mu"] == pytest.approx(closed["mu"], abs=1e-5)
    assert solved["L"] == pytest.approx(closed["L"], abs=1e-3)
    assert solved["residual"] > -1e-6


def test_drive_that_applied_nothing_exits_with_an_error() -> None:
    """No service listens at that port."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    service = f"http://127.0.0.1:{port}"
    answer = run("drive", "none:pointing", "--service", service, "--seconds", "0.3")
    assert answer.exit_code == 1
    assert "nothing was applied" in answer.stderr
    assert "Traceback" not in answer.stderr
