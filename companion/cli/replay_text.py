"""Text that ``companion replay`` prints at its end."""

from typing import Any, Final

from companion.values import Reason, kind_of


def text(summary: dict[str, Any]) -> str:
    """Return the summary of a replay as lines of text."""
    lines = [
        f"{summary['frames']} frames, {summary['duration_s']:.0f} s of log in"
        f" {summary['wall_s']:.1f} s; center {center_text(summary['center'])}"
    ]
    own = {uav: seen for uav, seen in summary["uavs"].items() if kind_of(uav).reports_itself}
    relayed = [seen["reports"] for uav, seen in summary["uavs"].items() if uav not in own]
    for uav, seen in own.items():
        lines.append(
            f"  {uav:12} {seen['state']:9} {seen['reports']:6} reports"
            f"  dt {_number(seen['dt_median_s'])} s  latency p95 {_number(seen['latency_p95_s'])} s"
            f"  innovation {_number(seen['innovation_rms_m'])} m rms"
        )
    if relayed:
        lines.append(f"  {len(relayed)} relayed aircraft (ADS-B), {sum(relayed)} reports")
    beams = summary["beams"]
    largest = beams["condition_number_max"]
    condition = "" if largest is None else f", condition number up to {_number(largest)}"
    lines.append(f"{beams['updates']} beam updates, {beams['regularised']} regularised{condition}")
    lines += [f"  not used: {n} {_REASONS[why].meaning}" for why, n in summary["rejected"].items()]
    lines += [f"  missing: {line}" for line in summary["missing"]]
    if summary["recording"]:
        lines.append(f"recording {summary['recording']}")
    return "\n".join([*lines, f"digest {summary['digest']}"])


_REASONS: Final = {str(reason): reason for reason in Reason}
CENTER_DECIMALS: Final = 7  # about 1 cm of latitude


def center_text(center: str) -> str:
    """Return a center as text; the numbers of a position have at most 7 decimals."""
    try:
        numbers = [float(part) for part in center.split(",")]
    except ValueError:
        return center  # a vehicle, or home
    return ",".join(f"{round(number, CENTER_DECIMALS):.12g}" for number in numbers)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
