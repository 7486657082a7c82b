"""A benchmark as a table, as JSON and as a log-log plot."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nlosrender.files.atomic_write import replacing
from nlosrender.files.file_kinds import PNG, REPORT

FAR = "never"
LABEL_STEP = 0.04  # between labels, of the height of the axes: a line of 8 points in 4 inches
NOTABLE = 0.1  # of the CPU time: setting up the engine is shown apart


def write_json(path: Path, report: dict[str, Any]) -> None:
    """Write ``Benchmark.report()``.

    Raises
    ------
    FileError
        The file cannot be written.
    """
    with replacing(path, REPORT) as partial:
        partial.write_text(json.dumps(report, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def table(report: dict[str, Any]) -> str:
    """Return ``Benchmark.report()`` as text."""
    facts = report["facts"]
    start, end = (" ".join(f"{x:.2f}" for x in facts[f"load_average_at_{when}"]) for when in ("start", "end"))
    lines = [
        f"{facts['started']}, {facts['processors']} processors, load average {start} at start and {end} at end",
        ", ".join(f"{name} {version}" for name, version in facts["versions"].items()),
    ]
    if facts.get("peer"):
        lines.append(
            f"against {facts['peer']}: same run, in turns; its result is scaled to fit best, once per laser point"
        )
    for scene in report["scenes"]:
        lines += ["", *_scene_table(scene)]
    if report["scaling"]:
        lines += ["", "scaling: median seconds to the same target error (auto)"]
    for scaling in report["scaling"]:
        steps = ", ".join(f"{n:g}: {s:.3g}" for n, s in zip(scaling["sizes"], scaling["seconds"], strict=True))
        exponent = "" if scaling["exponent"] is None else f"  ~ size^{scaling['exponent']:.2f} over the last sizes"
        lines.append(f"  {scaling['quantity']} ({scaling['setting']}): {steps}{exponent}")
        parts = list(zip(scaling["sizes"], scaling["cpu_seconds"], scaling["setup_seconds"], strict=True))
        if any(setup > NOTABLE * cpu for _, cpu, setup in parts):
            split = ", ".join(f"{n:g}: {cpu - setup:.3g} + {setup:.3g}" for n, cpu, setup in parts)
            lines.append(f"    CPU seconds, the second number for setting up the engine: {split}")
    if report["rates"]:
        lines += ["", "gather against Embree's any-hit queries on the same pairs of sensor point and patch"]
    for rate in report["rates"]:
        lines.append(
            f"  {rate['scene']}: {rate['patches']} patches, {rate['lit_patches']} lit, "
            f"{rate['gather_pairs_per_second'] / 1e6:.1f} M pairs/s; rays {rate['gather_rays_per_second'] / 1e6:.1f} "
            f"M/s gathered, {rate['any_hit_rays_per_second'] / 1e6:.1f} M/s any-hit: "
            f"{rate['gather_share_of_any_hit']:.0%}; of all pairs {rate['rays_left_out']:.0%} take no ray"
            + ("" if rate["traces_rays"] else " (nothing can occlude here)")
        )
    if report["skips"]:
        lines += ["", "skipped work: CPU seconds with and without the skip, and how far the results lie apart"]
    for skip in report["skips"]:
        lines.append(
            f"  {skip['what']} ({skip['scene']}): {skip['seconds']:.2f} instead of {skip['seconds_without']:.2f} s, "
            f"{skip['saved']:.0%} saved; {skip['difference']:.1e} apart"
        )
    if report["measure"]:
        lines += ["", "counting photons of 65536 histograms of 512 bins: response and pile-up"]
    for rate in report["measure"]:
        lines.append(
            f"  {rate['pile_up']}: {rate['seconds']:.2f} s on {rate['threads']} threads ({rate['cpu_seconds']:.2f} CPU "
            f"s), {rate['points_per_second']:.0f} histograms/s"
        )
    if report["factory"]:
        lines += [
            "",
            "captures an hour of a data set: a new mesh of 49298 triangles in each, confocal, third bounce, depth",
        ]
    lines += map(_factory_line, report["factory"])
    if report["process"]:
        lines += ["", _process_line(report["process"])]
    return "\n".join(lines)


def _scene_table(scene: dict[str, Any]) -> list[str]:
    reference = scene["reference"]
    lines = [
        f"{scene['scene']}: {scene['title']}",
        f"  truth: {reference['origin']}, own error about {reference['error']:.2%}, {reference['seconds']:.1f} s",
        f"  {'contender':<38}{'seconds to ' + format(scene['target'], '.0%'):>34}{'slope':>7}{'first run':>11}"
        f"{'M paths/s':>11}{'energy':>9}   error in seconds (CPU seconds)",
    ]
    for curve in scene["curves"]:
        seconds = curve["seconds_to_target"]
        reached = FAR if seconds is None else f"{seconds:.3g}"
        busy = "" if seconds is None else f", CPU {curve['cpu_seconds_to_target']:.3g}"
        shown = f"{reached}{busy} ({curve['seconds_to_target_is']})"
        slope = "" if curve["slope"] is None else f"{curve['slope']:.2f}"
        rate = curve["paths_per_second"]
        paths = "" if not rate else f"{rate / 1e6:.1f}"
        bias = f"{curve['energy_bias']:+.1%}"
        steps = ", ".join(
            f"{point['error']:.2%} in {point['seconds']:.2f} ({point['cpu_seconds']:.2f})"
            for point in curve["points"][-3:]
        )
        name = curve["name"] + (f" ({curve['engine']})" if curve["name"] == "auto" else "")
        lines.append(f"  {name:<38}{shown:>34}{slope:>7}{curve['first_seconds']:>9.2f} s{paths:>11}{bias:>9}   {steps}")
        if curve["bias"] is not None:
            lines.append(f"  {'':<38}biased: independent runs share an error of {curve['bias']:.2%}")
    return lines


def _factory_line(rate: dict[str, Any]) -> str:
    stages = ", ".join(f"{stage} {spent:.2f}" for stage, spent in rate["seconds"].items() if stage != "total")
    missed = f", {rate['missed']} above it" if rate["missed"] else ""
    return (
        f"  {rate['points']} x {rate['points']} x {rate['bins']}: {rate['captures_per_hour']:.0f} an hour "
        f"({rate['captures']} measured, {rate['cpu_seconds']:.2f} CPU s each); median seconds: {stages}; stated "
        f"{rate['stated_error']:.2%} of {rate['target']:.0%} asked{missed}; {rate['file_bytes'] / 1e6:.2f} MB"
    )


def _process_line(process: dict[str, Any]) -> str:
    stages = ", ".join(f"{stage} {spent:.2f}" for stage, spent in process["seconds"].items())
    return (
        f"nlosrender render of {process['scene']} at 1 %: {process['process_seconds']:.2f} s from start to exit "
        f"(first time {process['first_process_seconds']:.2f} s); inside: {stages}; writing "
        f"{process['file_bytes'] / 1e6:.1f} MB is {process['write_share']:.0%} of it"
    )


def write_plot(path: Path, report: dict[str, Any]) -> None:
    """Draw the error of every contender against seconds, one panel per scene; lines are labelled with their slopes.

    Raises
    ------
    FileError
        The file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from nlosrender.analysis.theme import GROUND

    scenes = report["scenes"]
    columns = min(2, max(1, len(scenes)))
    rows = max(1, -(-len(scenes) // columns))
    figure = Figure(figsize=(8.4 * columns, 5.2 * rows), facecolor=GROUND, layout="constrained")
    for axes, scene in zip(figure.subplots(rows, columns, squeeze=False).flat, scenes, strict=False):
        _draw_scene(axes, scene)
    for axes in figure.axes[len(scenes) :]:
        axes.set_axis_off()
    with replacing(path, PNG) as partial:
        FigureCanvasAgg(figure).print_figure(partial, dpi=130, format="png")


def _draw_scene(axes: Any, scene: dict[str, Any]) -> None:
    from matplotlib import colormaps

    from nlosrender.analysis.theme import FAINT, INK, style

    palette = colormaps["Set2"](range(8))  # bright enough to be read as text on the dark ground
    for number, curve in enumerate(scene["curves"]):
        peer = curve["name"].startswith("mitransient")
        seconds, errors = ([point[key] for point in curve["points"]] for key in ("seconds", "error"))
        line, marker = ("--", "s") if peer else ("-", "o")
        color = palette[number % len(palette)]
        axes.plot(seconds, errors, marker=marker, linestyle=line, markersize=4, color=color)
    axes.axhline(scene["target"], color=INK, linewidth=0.8, linestyle=":")
    axes.axhline(scene["reference"]["error"], color=FAINT, linewidth=0.8)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.grid(visible=True, which="major", color=FAINT, alpha=0.2)
    style(axes, textwrap.fill(scene["title"], 70), "seconds", "relative L2 error of H")
    _label_lines(axes, scene)


def _label_lines(axes: Any, scene: dict[str, Any]) -> None:
    """Write the name of every line at the right of the axes, as high as its end, pushed apart where they would meet."""
    names = [
        curve["name"] + ("" if curve["slope"] is None else f", slope {curve['slope']:.2f}") for curve in scene["curves"]
    ]
    right, bottom = axes.get_xlim()[1], axes.get_ylim()[0]
    axes.set(xlim=axes.get_xlim(), ylim=axes.get_ylim())  # no label may move the axes
    labelled = []
    for name, line in zip([*names, "target", "error of the reference"], list(axes.lines), strict=True):
        x, y = line.get_data()
        if len(y) and y[-1] > 0:
            labelled.append((name, line, (x[-1] if name in names else right, max(float(y[-1]), bottom))))
    to_axes = axes.transScale + axes.transLimits
    heights = pushed_apart([float(to_axes.transform(end)[1]) for _, _, end in labelled], LABEL_STEP)
    for (name, line, end), height in zip(labelled, heights, strict=True):
        leader = {"arrowstyle": "-", "color": line.get_color(), "linewidth": 0.5, "alpha": 0.6}
        text = {"color": line.get_color(), "fontsize": 8, "va": "center", "arrowprops": leader}
        axes.annotate(name, end, (1.02, height), textcoords="axes fraction", **text)


def pushed_apart(heights: Sequence[float], step: float) -> list[float]:
    """Return heights from 0 to 1 moved until they are at least ``step`` apart, in the same order."""
    order = sorted(range(len(heights)), key=lambda index: heights[index])
    placed = [min(max(heights[index], 0.0), 1.0) for index in order]
    for at in range(1, len(placed)):
        placed[at] = max(placed[at], placed[at - 1] + step)
    for at in reversed(range(len(placed))):  # those that were pushed out at the top come down again
        placed[at] = min(placed[at], 1.0 - (len(placed) - 1 - at) * step)
    found = dict(zip(order, placed, strict=True))
    return [found[index] for index in range(len(heights))]
