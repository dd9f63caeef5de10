"""Figures of the published array's beams: surfaces, cuts and polar patterns."""

from typing import TYPE_CHECKING, Final

import numpy as np

from companion.beams.array.geometry import Array
from companion.beams.array.steering import steering_matrix
from companion.beams.weights.precoding import precode
from companion.beams.worth import patterns
from companion.studies.figures import plotting
from companion.studies.paper import link
from companion.studies.paper.experiments import INSTANTS, SIZES, Material
from companion.values import ComplexArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FLOOR_DB: Final = -30.0  # lower gains are drawn at this value
POLAR_FLOOR_DB: Final = -15.0
TOP_DB: Final = 24.0


def weights(array: Array, position_m: FloatArray) -> ComplexArray:
    """Return zero-forcing weights (M, N) for UAVs at positions (N, 2)."""
    steering = steering_matrix(array, link.directions(position_m))
    return precode(steering, link.PRECODER).weights


def azimuths_rad(position_m: FloatArray) -> FloatArray:
    """Return azimuths (N,) of positions (N, 2) as seen from the array."""
    return np.arctan2(position_m[:, 1], position_m[:, 0])


def _cases(material: Material) -> list[tuple[Array, FloatArray, str]]:
    return [
        (
            material.arrays[size],
            material.flight.position_m[step],
            f"M = {size}, t = {material.flight.time_s[step]:.1f} s",
        )
        for size in SIZES
        for step in INSTANTS
    ]


def surfaces(material: Material) -> "Figure":
    """Draw gain over azimuth and elevation around the beam for UAV 1."""
    figure, panels = plotting.new(2, 2, (9.2, 6.9), subplot_kw={"projection": "3d"})
    cases = _cases(material)
    for axes, (array, places, _) in zip(panels, cases, strict=True):
        middle = _front_azimuth(float(azimuths_rad(places)[0]))
        azimuth = middle + np.radians(np.linspace(-12, 12, 193))
        elevation = np.radians(np.linspace(-40, 40, 81))
        gain = patterns.sphere(array, weights(array, places)[:, 0], azimuth, elevation)
        x, y = np.meshgrid(np.degrees(azimuth), np.degrees(elevation))
        axes.plot_surface(  # type: ignore[attr-defined]
            x, y, np.maximum(gain, -20.0), cmap=plotting.MAP, rcount=81, ccount=193,
            linewidth=0, antialiased=False, rasterized=True, vmin=-20, vmax=TOP_DB,
        )  # fmt: skip
        axes.set_xlabel("azimuth, °")
        axes.set_ylabel("elevation, °")
        axes.set_zlabel("gain, dB")  # type: ignore[attr-defined]
        axes.set_zlim(-20, TOP_DB)  # type: ignore[attr-defined]
        axes.view_init(elev=38, azim=-62)  # type: ignore[attr-defined]
        axes.set_box_aspect(None, zoom=0.95)  # type: ignore[call-arg]
    plotting.title_panels(panels, [title for *_, title in cases])
    return figure


def _front_azimuth(azimuth_rad: float) -> float:
    """Return the azimuth in front of a line of isotropic elements with the same response."""
    return float(np.arcsin(np.sin(azimuth_rad)))


def cuts(material: Material) -> "Figure":
    """Draw azimuth cuts around the beam for UAV 1 (above) and elevation cuts through it (below)."""
    figure, panels = plotting.new(2, 2, (9.2, 5.8), sharey=True)
    for column, step in enumerate(INSTANTS):
        places = material.flight.position_m[step]
        middle = _front_azimuth(float(azimuths_rad(places)[0]))
        for number, size in enumerate(SIZES):
            array = material.arrays[size]
            beam = weights(array, places)[:, 0]
            away_deg = np.linspace(-8, 8, 1601)
            elevation_deg = np.linspace(-90, 90, 3601)
            across = patterns.sphere(array, beam, middle + np.radians(away_deg), np.zeros(1))[0]
            up = patterns.sphere(array, beam, np.array([middle]), np.radians(elevation_deg))[:, 0]
            for axes, angle, gain in (
                (panels[column], away_deg, across),
                (panels[2 + column], elevation_deg, up),
            ):
                kept = plotting.line(number)
                axes.plot(angle, np.maximum(gain, FLOOR_DB), label=f"M = {size}", **kept)
                axes.axhline(gain.max() - 3.01, color=kept["color"], ls=":", lw=0.9)
        panels[column].set_xlabel(f"azimuth from the beam at {np.degrees(middle):.1f}°, degrees")
        panels[2 + column].set_xlabel("elevation, degrees")
        panels[column].set_xlim(-8, 8)
        panels[2 + column].set_xlim(-90, 90)
        panels[2 + column].set_xticks(np.arange(-90, 91, 30))
    for axes in panels[::2]:
        axes.set_ylabel("array gain, dB")
        axes.set_ylim(FLOOR_DB, TOP_DB)
    times = [f"t = {material.flight.time_s[step]:.1f} s" for step in INSTANTS]
    plotting.title_panels(
        panels, [f"{cut} cut, {t}" for cut in ("azimuth", "elevation") for t in times]
    )
    plotting.below(figure, panels[0], 2)
    return figure


def polar(material: Material) -> "Figure":
    """Draw full azimuth cuts of the beams for the first two UAVs, radius in dB."""
    figure, panels = plotting.new(2, 2, (8.0, 8.6), subplot_kw={"projection": "polar"})
    cases = _cases(material)
    for axes, (array, places, _) in zip(panels, cases, strict=True):
        beams = weights(array, places)
        for uav in (0, 1):
            angle, gain = patterns.azimuth_cut(array, beams[:, uav], 0.0, 7201)
            axes.plot(
                angle, np.maximum(gain, POLAR_FLOOR_DB), lw=0.8, label=f"beam for UAV {uav + 1}",
                **plotting.line(uav),
            )  # fmt: skip
        for number, azimuth in enumerate(azimuths_rad(places).tolist()):
            axes.plot(
                azimuth, TOP_DB, "o", color="#ffffff", mec=plotting.INK, ms=12, clip_on=False,
                zorder=5,
            )  # fmt: skip
            axes.annotate(
                str(number + 1), (azimuth, TOP_DB), ha="center", va="center", fontsize=8.5,
                zorder=6, annotation_clip=False,
            )  # fmt: skip
        axes.set_theta_zero_location("N")  # type: ignore[attr-defined]
        axes.set_theta_direction(-1)  # type: ignore[attr-defined]
        axes.set_rlim(POLAR_FLOOR_DB, TOP_DB)  # type: ignore[attr-defined]
        axes.set_rticks([-10, 0, 10, 20])  # type: ignore[attr-defined]
        axes.set_rlabel_position(45)  # type: ignore[attr-defined]
    plotting.title_panels(panels, [title for *_, title in cases])
    plotting.below(figure, panels[0], 2)
    return figure
