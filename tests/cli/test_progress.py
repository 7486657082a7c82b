"""What a command tells while it works: lines in a log, a bar on a terminal, warnings everywhere."""

from __future__ import annotations

import io
import itertools
import os
import re
import socket
import sys
from pathlib import Path

import pytest
from support.commands import run

from nlosrender.cli.progress import LogIntervals, ProgressLog, reporting
from nlosrender.config.document import Config
from nlosrender.config.load import load_config, load_document
from nlosrender.config.sweep_load import sweep_of
from nlosrender.pipeline import render_capture
from nlosrender.readable import readable_duration
from nlosrender.rendering.render_report import Progress, RenderReport, Standing, Warn
from nlosrender.rendering.sweep_render import render_sweep

SCENE = """\
name: plate
scene:
  relay_wall: {type: rectangle, width: 2.0, height: 1.6}
  hidden_geometry: [{type: rectangle, width: 0.5, height: 0.4, center: [0.1, 0, 0.9]}]
capture: {scan_type: exhaustive, sensor_grid: {nx: 5, ny: 3}, laser_grid: {nx: 2, ny: 7}}
time_axis: {start_opl: 1.5, bin_width_opl: 0.05, n_bins: 130}
render: {max_bounces: 3, spp: 32, engine: path, memory_limit: 500MB}
"""
WARNING = "warning: time_axis.start_opl is not 0"
DEFAULT = LogIntervals()
ALWAYS = LogIntervals(0.0, 0.0, 0.0)  # a line at every turn


class Clock:
    """Time that passes when it is told to."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def logged(shares: list[float], seconds: float, *standings: Standing) -> list[tuple[float, str]]:
    """Return the lines of a log, and when [s] they came, of work that moves on at equal times."""
    clock, lines = Clock(), []
    log = ProgressLog("render", lambda line: lines.append((clock.now, line)), DEFAULT, clock)
    for standing in standings:
        log.watch(standing)
    for number, share in enumerate(shares):
        clock.now = seconds * (number + 1) / len(shares)
        log.progress(share)
    return lines


def test_a_log_has_a_line_every_few_per_cent() -> None:
    """An hour of even progress: a line for each 5 %, with the share that is true then and the time that is left."""
    lines = logged([number / 3600 for number in range(1, 3601)], 3600.0)
    # 20 steps of 5 %: 180 s each, so that the line of every minute comes between them; the last one is that of 100 %
    assert 55 <= len(lines) <= 81
    for moment, line in lines[1:-1]:
        share, left = re.fullmatch(r"render: (\d+) %, about (.*) left, on .*", line).groups()
        assert float(share) == pytest.approx(100 * moment / 3600, abs=0.5 + 1e-9)  # printed without decimals
        assert left == readable_duration(3600 - moment)


def test_fast_work_does_not_flood_the_log() -> None:
    """A command of less than 5 s prints nothing; no two lines are closer than 10 s."""
    assert logged([number / 100 for number in range(101)], 4.9) == []
    moments = [moment for moment, _ in logged([number / 100 for number in range(101)], 60.0)]
    assert min(b - a for a, b in itertools.pairwise(moments)) >= DEFAULT.min_seconds


def test_work_that_stands_still_is_told_every_minute() -> None:
    """Units take minutes: the log goes on, so that a job that hangs is told from one that works."""
    clock, lines = Clock(), []
    log = ProgressLog("render", lines.append, DEFAULT, clock)
    for second in range(600):
        clock.now = float(second)
        log.write_if_due()
    assert len(lines) == 600 // DEFAULT.max_seconds


def test_a_line_tells_units_error_time_and_host() -> None:
    """The four things one looks into a log for; what earlier runs did is no measure for the speed of this one."""
    # 12 of 48 units were there: in 100 s the share went from 1/4 to 1/2, so that the other half takes 200 s
    ((_, line),) = logged([0.5], 100.0, Standing("units", 12, 48, 0.034))
    assert line == f"render: 12 of 48 units, 50 %, error so far 3.4 %, about 3.3 min left, on {socket.gethostname()}"
    ((_, line),) = logged([0.5], 100.0, Standing("captures", 1, 4), Standing("units", 3, 9, float("nan")))
    assert line.startswith("render: 1 of 4 captures, 3 of 9 units, 50 %, error so far unknown, about ")


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """A capture of several units, with a warning."""
    (tmp_path / "plate.yaml").write_text(SCENE)
    return tmp_path


@pytest.mark.parametrize("sweep", ["", "sweep: {keys: {render.seed: [1, 2, 3]}}\n"])
def test_a_batch_job_has_a_log(
    config: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], sweep: str
) -> None:
    """stderr is no terminal: units, share, error, time and host, of a capture as of a sweep, up to 100 %."""
    monkeypatch.chdir(config)
    path = config / "plate.yaml"
    path.write_text(SCENE + sweep)
    with reporting("sweep" if sweep else "render", False, ALWAYS) as listeners:
        if sweep:

            def render(own: Config, progress: Progress, warn: Warn, resume: bool | None) -> RenderReport:
                return render_capture(own, progress, warn, resume=resume, watch=listeners.watch)

            render_sweep(sweep_of(load_document(path)), render, **listeners._asdict())
        else:
            render_capture(load_config(path), **listeners._asdict())
    log, host = capsys.readouterr().err, re.escape(socket.gethostname())
    first = r"sweep: 0 of 3 captures, 0 %" if sweep else r"render: 0 of (\d+) units, 0 %"
    lines = [line for line in log.splitlines() if not line.startswith("warning")]
    assert any(re.match(first, line) for line in lines), log  # after those of the set-up
    middle = r"3 of 3 captures, (\d+) of \1 units" if sweep else r"(\d+) of \1 units"
    assert re.fullmatch(rf"\w+: {middle}, 100 %, error so far [\d.]+ %, after .*, on {host}", lines[-1]), log


@pytest.mark.parametrize("quiet", [False, True])
def test_quiet_silences_progress_and_report_but_no_warning(
    config: Path, capsys: pytest.CaptureFixture[str], quiet: bool
) -> None:
    """What may be wrong with a capture is in every log."""
    done = run(config, "render", "plate.yaml", *(["--quiet"] if quiet else []))
    assert done.stderr.count(WARNING) == 1
    assert ("wrote" in done.stdout, done.stdout == "") == (not quiet, quiet)
    with reporting("render", quiet, ALWAYS) as listeners:
        listeners.progress(0.5)
        listeners.warn("look out")
    assert ("render: " in (log := capsys.readouterr().err)) == (not quiet)
    assert "warning: look out" in log


class Terminal(io.TextIOWrapper):
    """A terminal as wide as one has told the system."""

    def __init__(self, columns: int):
        self.leader, follower = os.openpty()
        os.set_blocking(self.leader, False)
        import fcntl
        import struct
        import termios

        fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack("HHHH", 24 if columns else 0, columns, 0, 0))
        super().__init__(os.fdopen(follower, "wb", buffering=0), write_through=True)

    def shown(self) -> str:
        """Return what was printed so far."""
        return os.read(self.leader, 65536).decode()


@pytest.mark.parametrize(("columns", "bar"), [(80, True), (0, False)])
def test_a_terminal_of_unknown_width_gets_lines(monkeypatch: pytest.MonkeyPatch, columns: int, bar: bool) -> None:
    """A bar of no width shows nothing; containers and batch systems give such terminals."""
    terminal = Terminal(columns)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys, "stderr", terminal)
    with reporting("render", False, ALWAYS) as listeners:
        listeners.progress(0.5)
    assert ("\r" in terminal.shown().replace("\r\n", "\n")) == bar


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device of Linux")
def test_a_log_on_a_full_disk_stops_no_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """The render is worth more than its log."""
    full = Path("/dev/full").open("w")  # noqa: SIM115  # closing it would write again
    monkeypatch.setattr(sys, "stderr", full)
    with reporting("render", False, ALWAYS) as listeners:
        listeners.progress(0.5)
        listeners.warn("look out")
    os.dup2(os.open(os.devnull, os.O_WRONLY), full.fileno())
