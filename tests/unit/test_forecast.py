"""What is said before a render: sizes, what is skipped, what is pointless, how long it takes."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.partial_captures import write_capture
from support.rendering import configured, flat_wall

from nlosrender.analysis.render_plan import plan_render
from nlosrender.capture.bounces import BounceAxis
from nlosrender.capture.limits import refuse_impossible_grids, refuse_impossible_samples
from nlosrender.capture.part import Part, Tiling
from nlosrender.capture.plan import Batch, Plan, Tile, WorkItem
from nlosrender.engine.backend.start import start_backend
from nlosrender.errors import ConfigError
from nlosrender.files.size_estimate import FileSize, disk_warnings, forecast_size
from nlosrender.rendering import stages

BOX = (np.array([-0.4, -0.7, 0.5]), np.array([0.9, 0.2, 1.6]))
PLATE = {"type": "rectangle", "width": 0.5, "height": 0.4, "center": [0.1, 0, 0.9], "normal": [0, 0, -1]}
RED = {"type": "diffuse", "reflectance": [0.8, 0.1, 0.1]}
BALL = {"type": "sphere", "center": [0.5, 0.2, 1.1], "radius": 0.2}
ROOM = {"type": "room", "size": [2.0, 1.6, 1.5]}


def plan_of(batches: tuple[Batch, ...], replicas: int, bytes_per_batch: int) -> Plan:
    """A plan whose work items are single batches."""
    items = tuple(WorkItem(batch.sensors, batch.lasers, (batch,)) for batch in batches)
    return Plan(items, replicas, bytes_per_batch, Tiling(3, 5, 1, 1), Part((0, 1), (0, 15)))


# --- sizes ---


@pytest.mark.parametrize("scan_type", ["single", "confocal", "exhaustive"])
@pytest.mark.parametrize("variance", [True, False])
def test_an_unpacked_file_has_exactly_the_size_forecast(scan_type, variance, tmp_path):
    """Logical bytes are those of all datasets; without compression the stored chunks are known too.

    The grid takes several chunks per laser, the last ones of which are partly padding.
    """
    h5py = pytest.importorskip("h5py")
    config = configured(flat_wall(PLATE, scan=scan_type, sensors=(101, 97), lasers=(2, 3), bins=(0.0, 0.5, 29)))
    wall, _ = stages.place_scene(config)
    built = SimpleNamespace(wall=wall, hidden_bounds=BOX, unseen_bounds=BOX)
    capture, time_axis = stages.describe_capture(config, wall, built)
    header = stages.describe_file(config, built, capture, time_axis)
    size = forecast_size(header.sizes, header.confocal, (0.0, 0.5), compression="none", variance=variance)
    block = np.ones(
        [header.sizes[a] for a in ("channel", "bounce", "laser_y", "laser_x", "sensor_y", "sensor_x", "bin")]
    )
    block[:, 0] = 0  # the second bounce: dark, so not written
    write_capture(tmp_path / "x.hdf5", header, block, block if variance else None, compression="none")
    with h5py.File(tmp_path / "x.hdf5") as file:
        datasets = [file[name] for name in file]
        assert size.logical_bytes == sum(d.size * d.dtype.itemsize for d in datasets)
        stored = sum(d.id.get_storage_size() for d in datasets)
    # HEADER_BYTES stands for attributes and tables: 60 kB
    assert stored < size.disk_bytes_estimate < stored + 70_000


def test_packing_costs_what_is_lit():
    """With gzip the estimate follows the share of lit bins; dark bounces cost nothing."""
    sizes = {"channel": 1, "bounce": 2, "laser_y": 2, "laser_x": 3, "sensor_y": 40, "sensor_x": 50, "bin": 1000}
    dark, half, full = (
        forecast_size(sizes, False, (0.0, share), compression="gzip", variance=False) for share in (0.0, 0.5, 1.0)
    )
    assert dark.logical_bytes == half.logical_bytes == full.logical_bytes
    assert full.disk_bytes_estimate - dark.disk_bytes_estimate == 2 * 3 * 40 * 50 * 1000 * 4
    assert 0.49 < half.disk_bytes_estimate / full.disk_bytes_estimate < 0.52


def test_what_the_pilot_saw_tightens_the_size_and_never_loosens_it():
    """Boxes bound the light of every bounce; the share of bins a pilot lit replaces a bound that is larger."""
    from nlosrender.rendering.render_warnings import expected_file_size

    config = configured(flat_wall(PLATE, BALL, sensors=(50, 30), max_bounces=5))
    _, _, engine = prepared(config)
    header = stages.describe_file(config, engine.built, engine.capture, engine.time_axis)
    bound, dark, loose = (
        expected_file_size(config, header, engine, lit).disk_bytes_estimate
        for lit in (None, (0.0, None, 0.0, 0.0), (1.0, None, 1.0, 1.0))
    )
    assert dark < bound / 2
    assert loose == bound


def test_a_full_disk_and_a_missing_folder_are_said(tmp_path):
    """Both are found without writing."""
    small, huge = FileSize(1, 1, 0.0, ""), FileSize(10**18, 10**18, 0.0, "")
    assert list(disk_warnings(tmp_path / "x.hdf5", small)) == []
    (warning,) = disk_warnings(tmp_path / "x.hdf5", huge)
    assert "1e+06 TB may be written" in warning
    (warning,) = disk_warnings(tmp_path / "no" / "x.hdf5", small)
    assert "there is no folder" in warning


@pytest.mark.parametrize(
    ("overrides", "match"),
    [
        (["capture.sensor_grid={nx: 1000000, ny: 99999}"], r"capture\.sensor_grid: 1000000 x 99999 points"),
        (["capture.laser_grid={nx: 1000000, ny: 9999}"], r"capture\.laser_grid: 1000000 x 9999 points"),
        (["time_axis.n_bins=3000000000"], "n_bins: got 3000000000, need at most 2147483647"),
        (["time_axis.n_bins=1000000000", "render.memory_limit=1GB"], "one sensor point with one laser needs"),
        (
            ["capture.sensor_grid={nx: 160, ny: 160}", "capture.laser_grid={nx: 160, ny: 160}"],
            r"are more than 2\*\*40 samples",
        ),
        (
            [
                "capture.sensor_grid={nx: 600, ny: 600}",
                "capture.laser_grid={nx: 50, ny: 50}",
                "time_axis.n_bins=1200",
                "render.memory_limit=401MB",
            ],
            "more than 1_000_000 batches",
        ),
    ],
)
def test_impossible_sizes_are_refused_before_anything_is_allocated(overrides, match):
    """What no machine holds is an error at once, for plan and render alike."""
    config = configured(flat_wall(PLATE, scan="exhaustive", bins=(0.0, 0.001, "auto")), overrides)
    tracemalloc.start()
    try:
        with pytest.raises(ConfigError, match=match):
            plan_render(config)
        assert tracemalloc.get_traced_memory()[1] < 400e6  # 600 x 600 points have 230 MB of their own
    finally:
        tracemalloc.stop()


def test_possible_sizes_are_not_refused():
    """The limits let through what fits."""
    config = configured(flat_wall(PLATE, scan="exhaustive", sensors=(50, 30)))
    refuse_impossible_grids(config.capture, memory_limit=2_000_000)
    refuse_impossible_samples(config.capture, rows_per_pair=2, n_bins=300, memory_limit=1_000_000)
    with pytest.raises(ConfigError, match=r"sensor_grid: 50 x 30"):
        refuse_impossible_grids(config.capture, memory_limit=500_000)


# --- what is skipped, what is pointless ---


def prepared(config):
    backend = start_backend("llvm", colored=config.is_colored)
    built = stages.load_scene(config)
    capture, time_axis = stages.describe_capture(config, built.wall, built)
    plan, engine = stages.prepare(config, backend, built, capture, time_axis)
    return backend, plan, engine


def skipped(*hidden, wall=None, **render) -> dict[str, str]:
    scene = flat_wall(*hidden, **{"spp": None, "engine": "auto", **render})
    scene["scene"]["relay_wall"] = wall or scene["scene"]["relay_wall"]
    config = configured(scene)
    _, _, engine = prepared(config)
    from nlosrender.engine.preflight.omitted_work import omitted_work  # the backend has to be started before

    items = omitted_work(engine, scene_is_colored=config.scene.is_colored)
    return {item.what: item.why for item in items}


BOX_ITEM = {"type": "box", "center": [0, 0, 1], "size": [0.3, 0.2, 0.4]}
TUBE = {"type": "cylinder", "center": [0, 0, 0], "axis": [0, 1, 0], "radius": 1.0, "height": 2.0, "inside": True}


@pytest.mark.parametrize(
    ("what", "holds", "does_not"),
    [
        ("second bounce", ((PLATE,), {}), ((PLATE,), {"wall": TUBE})),
        ("bounces above 4", ((PLATE,), {"max_bounces": 4}), ((PLATE,), {"max_bounces": None})),
        ("shadow rays", ((PLATE,), {}), ((PLATE, BALL), {})),
        ("shadow rays", ((PLATE,), {"engine": "path"}), ((PLATE, BALL), {"engine": "path"})),
        (
            "half of the pairs of laser and sensor points",
            ((PLATE,), {"scan": "exhaustive", "capture": {"laser_grid": {"nx": 5, "ny": 3}}}),
            ((PLATE,), {"scan": "exhaustive", "capture": {"laser_grid": {"nx": 5, "ny": 4}}}),
        ),
        ("2 of 12 triangles", ((BOX_ITEM,), {}), ((PLATE,), {})),
        ("colour", ((PLATE,), {}), (({**PLATE, "bsdf": RED},), {})),
        ("colour", (({**PLATE, "bsdf": RED},), {"color": "grey"}), ((PLATE,), {"color": "rgb"})),
        ("BSDF sampling at the wall (MIS)", ((PLATE,), {"engine": "path"}), ((ROOM,), {"engine": "path"})),
        (
            "BSDF sampling at the wall (MIS)",
            ((PLATE,), {"max_bounces": 4, "engine": "path"}),
            ((PLATE,), {"max_bounces": 4}),
        ),
        (
            "rays from the wall that miss the box around all hidden geometry",
            ((PLATE,), {"hidden_geometry_sampling": False}),
            ((ROOM,), {"hidden_geometry_sampling": False}),
        ),
        (
            "rays from the wall that miss the box around all hidden geometry",
            ((BALL,), {"hidden_geometry_sampling": False}),
            ((PLATE,), {"engine": "path"}),
        ),
        ("hidden geometry sampling (MIS)", ((ROOM,), {"engine": "path"}), ((PLATE,), {"engine": "path"})),
        (
            "hidden geometry sampling (MIS)",
            ((PLATE,), {"hidden_geometry_sampling": False}),
            ((PLATE,), {"engine": "path"}),
        ),
    ],
)
def test_a_skip_is_said_exactly_when_its_condition_holds(what, holds, does_not):
    """Each line of the plan stands for something the engine really leaves out, and names the reason."""
    assert skipped(*holds[0], **holds[1])[what]
    assert what not in skipped(*does_not[0], **does_not[1])


def test_no_triangle_is_said_to_be_skipped_when_none_is():
    """A plate that faces the wall is used whole."""
    assert not [what for what in skipped(PLATE) if "triangles" in what]


def warnings_of(*hidden, scan="exhaustive", **keys) -> list[str]:
    from nlosrender.engine.preflight.scene_warnings import scene_warnings

    _, _, engine = prepared(configured(flat_wall(*hidden, scan=scan, **{"spp": None, "engine": "auto", **keys})))
    return list(scene_warnings(engine))


BACK = {"normal": [0, 0, 1]}
SCREEN = {"type": "rectangle", "width": 5.0, "height": 5.0, "center": [0, 0, 0.5], "normal": [0, 0, -1]}


def test_a_plain_scene_has_no_warnings():
    """Two visible things of different kinds, for every scan type."""
    for scan in ("single", "confocal", "exhaustive"):
        assert warnings_of(PLATE, BALL, scan=scan) == []


@pytest.mark.parametrize(
    ("item", "match"),
    [
        ({**PLATE, **BACK}, "turns its back to the relay wall"),
        ({**PLATE, "center": [0, 0, -0.3]}, "lies behind the relay wall"),
        ({**BALL, "center": [0, 0, -0.3]}, "lies behind the relay wall"),
        ({**PLATE, **BACK, "bsdf": {"type": "twosided", "a": {"type": "diffuse"}}}, None),
        ({"type": "mitsuba", "shape": {"type": "disk", "to_world": [{"translate": [0, 0, 1]}]}}, "turns its back"),
    ],
)
def test_an_item_that_returns_no_light_is_named(item, match):
    """It alone is named when something else is visible; alone it makes the whole capture dark."""
    said = warnings_of(BALL, item)
    assert len(said) == (match is not None)
    if match:
        assert said[0].startswith("scene.hidden_geometry.1 (")
        assert match in said[0]
        assert any("no hidden surface faces the relay wall" in text for text in warnings_of(item))


def test_an_item_behind_another_is_said():
    """A screen hides the plate; without the screen nothing is said; a screen with a hole beside it lets light by."""
    (warning,) = warnings_of(SCREEN, PLATE)
    assert "hidden_geometry.1" in warning
    assert "is hidden from the relay wall by what lies between" in warning
    assert warnings_of({**SCREEN, "width": 0.3, "height": 0.3}, PLATE) == []


def test_an_item_the_laser_does_not_see_is_pointless_for_the_third_bounce_only():
    """A blind before the one laser point hides the plate from it, not from the sensors."""
    blind = {**SCREEN, "width": 0.3, "height": 0.3, "center": [0.3, -0.2, 0.02]}
    plate = {**PLATE, "center": [-0.5, -0.2, 0.5]}
    (warning,) = warnings_of(blind, plate, scan="single")
    assert warning.startswith("scene.hidden_geometry.1 (rectangle-1) is seen from no laser point")
    assert warnings_of(blind, plate, scan="single", max_bounces=5) == []


def test_a_closed_sphere_seen_from_within_hides_its_bright_side():
    """Its outside is black and in the way: the laser sees nothing of it, and H is zero."""
    hollow = {**BALL, "inside": True}
    (warning,) = warnings_of(PLATE, hollow)
    assert "hidden_geometry.1 (sphere-1) is hidden from the relay wall" in warning
    assert "no laser point sees any of the hidden geometry" in warnings_of(hollow)[-1]


def test_bins_finer_than_the_arithmetic_are_said():
    """Bins of a micrometre in a room-sized scene, but not of a tenth of a millimetre."""
    assert warnings_of(PLATE, bins=(0.0, 1e-4, 60_000)) == []
    said = warnings_of(PLATE, bins=(0.0, 1e-7, 60_000))
    assert any("finer than path lengths" in text for text in said)
    assert any("patches of the hidden geometry are needed" in text for text in said)


def test_triangles_that_take_more_than_the_memory_limit_are_said():
    """A limit is for the process: what a mesh takes is in no batch."""
    from nlosrender.engine.preflight.batch_memory import memory_warnings

    _, plan, engine = prepared(configured(flat_wall(PLATE)))
    engine.built = replace(engine.built, n_triangles=10**6)
    (warning,) = memory_warnings(engine, plan, 10**9, 128)
    assert "1000000 triangles take about 700 MB beside the program's 400 MB, more than 1 GB" in warning
    assert list(memory_warnings(engine, plan, 2 * 10**9, 128)) == []
    assert list(memory_warnings(engine, plan, None, 128)) == []


def test_a_memory_limit_is_checked_against_machine_and_lanes():
    """A limit above the machine's memory, and one that leaves processors idle, are said; a plain one is not."""
    from nlosrender.engine.preflight.batch_memory import memory_warnings

    config = configured(flat_wall(PLATE, scan="exhaustive", sensors=(50, 30), lasers=(9, 8)))
    backend, plan, engine = prepared(config)
    assert list(memory_warnings(engine, plan, None, 128)) == []
    assert "is more than the machine's" in next(memory_warnings(engine, plan, 10**16, 128))
    cut = plan_of((Batch(Tile(0, 1, 0, 2), Tile(0, 8, 0, 9)),) * 750, plan.replicas, 10**6)
    (warning,) = memory_warnings(engine, cut, 10**9, backend.lanes)
    assert "batches of 2 sensor points, too few" in warning


@pytest.mark.parametrize(
    ("engine", "message"),
    [
        ("path", r"^render\.memory_limit: a batch takes .* Lower it, or use fewer bins or sensor points\.$"),
        ("virtual_lights", r"^render\.engine: a batch takes .* fewer bins or lasers, or render\.engine: path\.$"),
    ],
)
def test_a_batch_larger_than_the_machine_is_the_configurations_fault(monkeypatch, engine, message):
    """The key that helps is named: only the gather needs rows for every processor."""
    from nlosrender.engine.preflight import batch_memory as memory

    _, plan, used = prepared(configured(flat_wall(PLATE, engine=engine, spp=None)))
    monkeypatch.setattr(memory, "physical_memory", lambda: 1000)
    monkeypatch.setattr(memory, "batch_memory", lambda limit, n_triangles: 10**12)
    with pytest.raises(ConfigError, match=message):
        list(memory.memory_warnings(used, plan, None, 128))


def test_the_gather_takes_what_is_said():
    """Its sums, in whole blocks of bins; and a batch of few points does not take rows for every processor."""
    from nlosrender.engine.virtual_lights.gather.block_histogram import BlockHistogram

    config = configured(flat_wall(PLATE, sensors=(50, 30), bins=(0.0, 9.0, 1), engine="auto", spp=None))
    _, plan, engine = prepared(config)
    shape = engine.third.shape(plan.batches[0])
    histogram = BlockHistogram(shape, np.arange(shape.sensors))
    n_sums = len(histogram.sums) + len(histogram.outside)
    assert engine.batch_bytes(plan) == max(plan.bytes_per_batch, 8 * n_sums)
    small = plan_of((Batch(Tile(0, 1, 0, 2), Tile(0, 1, 0, 1)),) * 750, plan.replicas, 1)
    assert engine.batch_bytes(small) == pytest.approx(8 * n_sums / 750)


# --- how long ---


class _ClockworkPaths:
    """A path engine whose renders take a known time and have a known error: 1 / sqrt(samples)."""

    def __init__(self, clock, overhead=0.02, per_path=1e-5):
        self.clock, self.overhead, self.per_path = clock, overhead, per_path
        self.capture = SimpleNamespace(scan_type="single", n_sensors=15)
        self.options = SimpleNamespace(bounces=BounceAxis(3, True))
        self.scale = 1.0
        self.sees_light = True

    def calibrate(self, budget, seconds):
        """1 / sqrt(n) = target at n = target^-2."""
        target = budget.target_error
        return budget if target is None else replace(budget, spp=round(target**-2) if self.sees_light else None)

    def cost_estimate(self, plan, budget, lanes, pilot):
        from nlosrender.engine.launch.cost_pilot import sampling_estimate

        return sampling_estimate(self, plan, budget, lanes, pilot)

    def render(self, batch, budget, passes=None):
        from nlosrender.engine.launch.histogram import Histogram

        samples = budget.spp * 2 if budget.spp else 1000
        self.clock.now += self.overhead + self.per_path * samples * batch.sensors.size
        mean = np.ones((1, 2, 1, batch.sensors.size, 4))
        # the estimate's square holds the variance too: truth^2 = 1 - v, relative error^2 = v / (1 - v)
        return Histogram(mean, np.full_like(mean, 1 / (1 + samples)), mean[..., 0], samples, np.zeros((1, 1, 2)))


@pytest.fixture
def clockwork(monkeypatch):
    from nlosrender.engine.launch import cost_pilot

    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(cost_pilot.time, "perf_counter", lambda: clock.now)
    return _ClockworkPaths(clock)


OVERHEAD_PATHS = 3.1e-4  # s: the overhead is measured with two paths per sensor point, 2 * 15 * 1e-5 s
WHOLE = plan_of((Batch(Tile(0, 3, 0, 5), Tile(0, 1, 0, 1)),), 2, 1000)


def test_time_is_linear_in_paths(clockwork):
    """A clockwork of known speed is extrapolated exactly: samples, sensor points, overhead."""
    from nlosrender.engine.interface import Budget
    from nlosrender.engine.preflight.time_estimate import estimate_render_time

    for spp in (100, 5000):
        estimate = estimate_render_time(clockwork, WHOLE, Budget(spp=spp), lanes=8)
        assert estimate.seconds == pytest.approx(spp * 15 * 1e-5 + 0.02, abs=OVERHEAD_PATHS)


def test_half_the_error_takes_four_times_as_long(clockwork):
    """What the engine settles is what is extrapolated: 1 / sqrt(n) = target at n = target^-2."""
    from nlosrender.engine.interface import Budget
    from nlosrender.engine.preflight.time_estimate import estimate_render_time

    for target in (0.02, 0.01):
        estimate = estimate_render_time(clockwork, WHOLE, Budget(target_error=target), lanes=8)
        assert estimate.seconds == pytest.approx(target**-2 * 15 * 1e-5 + 0.02, abs=OVERHEAD_PATHS)


def test_a_time_limit_is_never_exceeded(clockwork):
    """Alone it is the answer; beside another goal it caps it."""
    from nlosrender.engine.interface import Budget
    from nlosrender.engine.preflight.time_estimate import estimate_render_time

    assert estimate_render_time(clockwork, WHOLE, Budget(time_limit_s=7), lanes=8).seconds == 7
    assert estimate_render_time(clockwork, WHOLE, Budget(spp=10**9, time_limit_s=7), lanes=8).seconds == 7
    assert estimate_render_time(clockwork, WHOLE, Budget(spp=10, time_limit_s=7), lanes=8).seconds < 1


def test_pure_noise_gives_no_number(clockwork):
    """No estimate is better than a wrong one."""
    from nlosrender.engine.interface import Budget
    from nlosrender.engine.preflight.time_estimate import estimate_render_time

    clockwork.sees_light = False
    estimate = estimate_render_time(clockwork, WHOLE, Budget(target_error=0.01), lanes=8)
    assert estimate.seconds is None
    assert "noise" in estimate.basis


def test_the_pilot_lies_within_a_batch_and_its_memory():
    """However large the batch, the pilot takes PILOT_BYTES or one sensor point, in the middle of it."""
    from nlosrender.engine.launch.cost_pilot import PILOT_BYTES, pilot_batch

    capture = SimpleNamespace(scan_type="single")
    for rows, columns, n_bytes in ((30, 50, 10**10), (3, 500, 10**9), (40, 1, 10**9), (2, 3, 10**12), (3, 5, 10)):
        whole = Tile(10, 10 + rows, 20, 20 + columns)
        pilot = pilot_batch(capture, plan_of((Batch(whole, Tile(0, 1, 0, 1)),), 2, n_bytes)).sensors
        assert whole.y0 <= pilot.y0 < pilot.y1 <= whole.y1
        assert whole.x0 <= pilot.x0 < pilot.x1 <= whole.x1
        assert pilot.size == 1 or pilot.size * n_bytes / whole.size <= PILOT_BYTES
        if n_bytes <= PILOT_BYTES:
            assert pilot == whole


def test_many_lasers_are_cut_once_the_pilot_is_down_to_one_sensor_point():
    """An exhaustive capture with a million lasers must not make the forecast as heavy as the render."""
    from nlosrender.engine.launch.cost_pilot import PILOT_BYTES, pilot_batch

    capture = SimpleNamespace(scan_type="exhaustive")
    lasers = Tile(0, 1000, 0, 999)
    few, many = (
        pilot_batch(capture, plan_of((Batch(Tile(0, 1, 0, 2), lasers),), 2, int(n_bytes)))
        for n_bytes in (2 * PILOT_BYTES, 20 * PILOT_BYTES)
    )
    assert (few.sensors.size, few.lasers) == (1, lasers)
    assert many.sensors.size == 1
    assert many.lasers.size <= lasers.size / 10
