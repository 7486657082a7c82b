"""The starter config of ``nlosrender new``: every key, with unit, allowed values and default, ready to render."""

from __future__ import annotations

from nlosrender.config.capture import ScanType

_LASER_KEYS: dict[ScanType, str] = {
    "single": """\
  laser_point: [0.0, 0.0]        # m, wall coordinates (x, y) from the wall's centre; default [0, 0]
  # laser_grid: {nx: 4, ny: 3}   # scan_type: exhaustive only; keys as sensor_grid
""",
    "confocal": """\
  # laser_point: [0.0, 0.0]      # m, wall coordinates; scan_type: single only
  # laser_grid: {nx: 4, ny: 3}   # scan_type: exhaustive only; keys as sensor_grid
""",
    "exhaustive": """\
  laser_grid: {nx: 4, ny: 3, width: 1.5, height: 1.5}  # the lit points; keys as sensor_grid
  # laser_point: [0.0, 0.0]      # m, wall coordinates; scan_type: single only
""",
}

# What is there or, behind a comment sign, could be there.
_WALL = """\
  relay_wall:                    # the visible surface
    type: rectangle              # rectangle | sphere | cylinder | mesh
    width: 2.0                   # m, along the wall's x axis (up x normal)
    height: 2.0                  # m, along the wall's y axis (up)
    center: [0, 0, 0]            # m; default [0, 0, 0]
    normal: [0, 0, 1]            # any direction; hidden geometry lies on this side; default [0, 0, 1]
    up: [0, 1, 0]                # the wall's y axis; default [0, 1, 0]
    bsdf: {type: diffuse, reflectance: 1.0}  # any Mitsuba BSDF; reflectance: 0..1, [r, g, b], texture; default this
"""
_EMITTERS = """\
  emitters:
  - {type: rectangle, width: 0.5, height: 0.4, center: [0, 2, 0], normal: [0, -1, 0], up: [0, 0, 1], radiance: 10.0}
  - {type: point, position: [0, 1, -1], intensity: [1.0, 0.9, 0.8]}
  - {type: spot, position: [0, 1, -2], look_at: [0, 0, 0.8], intensity: 1.0, cutoff_deg: 20, beam_deg: null}
"""
_CAMERA = """\
  camera:                        # line_of_sight, instead of everything about sensors and lasers below
    {position: [0, 0.5, -3], look_at: [0, 0, 0.8], up: [0, 1, 0], fov_deg: 40, width: 64, height: 48}  # pixels
"""
_PIXELS = """\
  # Other scans with a camera: what each of its pixels sees first is a sensor point, on any surface (docs/scans.md);
  # instead of sensor_grid, sensor_position, laser_point, laser_grid. No relay_wall is needed.
  # pixel_point: [0.5, 0.5]      # where in its pixel a point is seen, from the lower left corner; default the centre
  # laser_target: [0, 0, 0]      # single: the beam from laser_position to it lights what it meets first
  # laser_targets: [[0, 0, 0]]   # exhaustive: several; default null: the points of the pixels
  # footprint: {pixel: true}     # H is the mean over all that a pixel sees; default null: over its point alone
"""
_SENSOR_GRID = """\
  sensor_grid:                   # the measured points: cell centres (i + 0.5) / n
    nx: 32                       # integer >= 1
    ny: 32                       # integer >= 1
    width: 2.0                   # m; default null: the whole wall
    height: 2.0                  # m; default null: the whole wall
  # sensor_points: {file: points.csv}  # instead of sensor_grid: x,y in wall coordinates [m] (.csv, .npy), or a list
  # laser_points: [[0.0, 0.0], [0.1, 0.2]]  # instead of laser_grid, as sensor_points
  # laser_spots: [[0.0, 0.0], [0.1, 0.2]]  # instead of laser_point: lit by one pulse at once, with multiplex: true
  # multiplex: true
  # laser_flash: {fov_deg: 40}   # instead: a cone from laser_position around the way to laser_point
  # laser_spot_weights: [1, 2]   # how they share the pulse's energy, any unit; default null: equally
"""
_DEVICES = """\
  laser_position: [-0.5, 0, 0.25]     # m, in front of the wall; default null: 1 m in front of its centre
  sensor_position: [-0.5, 0, 0.25]    # m, in front of the wall; default null: 1 m in front of its centre
  laser_energy: 1.0              # J per pulse, > 0; default 1
  laser_spot_radius: 0.0         # m, >= 0; default 0: the laser lights a point
  # footprint: {radius: 0.02}    # m; or box: [0.04, 0.03]: H is the mean over it around each sensor point; default null
"""

_TEMPLATE = """\
# A capture for nlosrender. Lengths in metres, times as optical path length (OPL) in metres.
# Render it with: nlosrender render {file}
name: {name}  # default: the name of this file

scene:
{wall}\
  # A curved wall; inside: true (default) = lit from within; width, height: default extent of the grids.
  # relay_wall: {{type: sphere, center: [0, 0, 0], radius: 1.0, inside: true, width: 2.0, height: 1.0}}
  # relay_wall: {{type: cylinder, center: [0, 0, 0], axis: [0, 1, 0], radius: 1.0, height: 2.0, inside: true}}
  # A mesh with texture coordinates, which are its wall coordinates; width, height: what 0..1 is in m; default null.
  # relay_wall: {{type: mesh, filename: wall.ply, scale: 1, rotate_deg: [0, 0, 0], translate: [0, 0, 0],
  #              flip_normals: false, width: null, height: null, made_by: null}}  # made_by: the command that makes a
  #              file, told when it is missing; any mesh may have it

  hidden_geometry:               # a list; default [] (nothing hidden)
    - name: plate                # default: type and index, here rectangle-0
      type: rectangle            # rectangle | mesh | letters | box | sphere | cylinder | room | mitsuba
      width: 0.6                 # m
      height: 0.4                # m
      center: [0, 0, 0.8]        # m
      normal: [0, 0, -1]         # the front side; default [0, 0, -1]
      up: [0, 1, 0]              # default [0, 1, 0]
      bsdf: {{type: diffuse, reflectance: 0.7}}  # default reflectance 1.0
    # A picture has its first row at the item's up side, its first column at the left as seen from the front:
    # bsdf: {{type: diffuse, reflectance: {{type: bitmap, filename: wood.png, raw: true}}}}  # see docs/textures.md
    # bsdf: {{type: retroreflector, width: 0.5, albedo: 0.3, diffuse: 0.2}}  # degrees; see docs/retroreflectors.md
    # Further items, one example of each type. rotate_deg: degrees about x, then y, then z.
    # - {{type: mesh, filename: bunny.ply, scale: 1, rotate_deg: [0, 90, 0], translate: [0, 0, 1], normals: auto}}
    #   # scale: a number or [x, y, z], negative mirrors; normals: auto, file, flat or smooth, or face_normals: true
    #   # for flat ones; see docs/meshes.md. fit: {{largest: 0.8}}: that size [m], centred on translate; default null
    # - {{type: letters, text: Z, height: 0.8, thickness: 0.0, stroke_width: null, spacing: null, center: [0, 0, 1]}}
    # - {{type: box, center: [0, 0, 1], size: [0.3, 0.2, 0.1], rotate_deg: [0, 0, 30]}}
    # - {{type: sphere, center: [0, 0, 1], radius: 0.3, inside: false}}
    # - {{type: cylinder, center: [0, 0, 1], axis: [0, 1, 0], radius: 0.1, height: 0.5, inside: false}}
    # - {{type: room, size: [3, 2.5, 4]}}
    # to_world: a 4x4 matrix, or translate, scale, rotate: {{axis: [0, 1, 0], angle_deg: 90}}, applied in order.
    # - {{type: mitsuba, shape: {{type: cube, to_world: [{{scale: 0.2}}, {{translate: [0, 0, 1]}}]}}}}

  # What a camera sees of the scene itself (capture.scan_type: line_of_sight): no relay_wall, but emitters that flash at
  # t = 0: any item as above with a radiance [W m^-2 sr^-1], or a point or a spot with an intensity [W sr^-1].
{emitters}\
  # mitsuba: scene.xml           # a whole Mitsuba scene in m; its camera is used where capture has none

capture:
  scan_type: {scan_type}{pad}# single | confocal | exhaustive | line_of_sight
{camera}\
{pixels}\
{grids}\
  account_first_and_last_bounces: true  # count the legs laser to wall and wall to sensor in time; default true

time_axis:
  start_opl: 0.0                 # m, start of bin 0; default 0
  bin_width_opl: {bin_width}{bin_pad}# m, > 0; default 0.003 (10 ps)
  n_bins: auto                   # auto | integer >= 1; default auto: up to the latest possible arrival

render:
  engine: auto                   # auto | path | virtual_lights; default auto
  max_bounces: 7                 # integer >= 2 (line_of_sight: >= 0), or null for no limit; 3 = third bounce; default 7
  split_bounces: true            # each bounce on its own index of the file; default true
  target_error: 0.05             # relative L2 error of H to stop at, 0..1; default 0.05; or:
  # spp: 1024                    # paths per pair of laser and sensor point, instead of target_error
  time_limit_s: null             # s, > 0; stop after this time; default null: no limit
  laser_sampling: true           # connect paths to the laser point; false needs laser_spot_radius > 0; default true
  hidden_geometry_sampling: true # sample points on the hidden geometry; default true
  temporal_kernel_opl: 0.0       # m, width of a kernel in time that smooths the noise of paths; default 0: a histogram
  russian_roulette: true         # end weak paths early, without bias; virtual lights always do; default true
  seed: 0                        # 0..4294967295; default 0
  backend: auto                  # auto | llvm | cuda; default auto
  color: auto                    # auto | grey | rgb; default auto: rgb only where the scene has colours
  polarized: false               # true: I, Q, U, V of polarised light instead of colours
  memory_limit: auto             # auto | "600MB" | "8GB" | "2GiB"; default auto

output:
  path: {name}.hdf5  # default: <name>.hdf5, in the current directory
  format: znlos                  # znlos
  frame: znlos                   # znlos (wall in y = 0) | scene (coordinates as above); default znlos
  compression: gzip              # gzip | none; default gzip
  variance: true                 # store the variance of the estimate per bin; default true
  ground_truth: []               # depth, normal, albedo, position, instance, occupancy, poses; default []: none
  ground_truth_grid: null        # {{nx: 64, ny: 64, nz: 64, near: 0.5, far: 1.5}}; default null: the sensor grid

# What a detector counts of it, in a dataset counts beside the ideal data; docs/measured.md.
# sensor:
#   profile: spad-532            # one of `nlosrender measure --list`, or a YAML file; keys below win; default null
#   photons_per_pulse: {{mean: 0.05}}  # or {{brightest: x}}: photons per histogram; null: physical, by the next four
#   wavelength_nm: null          # nm, > 0
#   aperture_solid_angle: null   # sr, > 0
#   footprint_area: null         # m^2, > 0; null: a cell of the sensor grid
#   transmission: 1.0            # 0..1
#   photon_detection_ratio: 1.0  # 0..1
#   laser_jitter_fwhm_ps: 0      # ps, of the laser pulse; default 0
#   jitter_fwhm_ps: 0            # ps, of the detector; default 0
#   jitter_tail_ps: 0            # ps, decay constant of an exponential tail; default 0
#   jitter_tail_share: null      # 0..1, of the detections; null: 1 with jitter_tail_ps
#   jitter_file: null            # .csv, .npy or .hdf5: a measured response instead
#   jitter_file_bin_ps: null     # ps, of its cells where the file does not say
#   zero_delay: peak             # peak | mean: what of the response is no delay
#   bin_width_opl: null          # m of optical path, or bin_width_ps; null: as time_axis
#   n_bins: null                 # integer >= 1; null: to the end of time_axis, or of the laser's period
#   start_opl: null              # m of optical path; null: as time_axis
#   gate: null                   # [from, to] m of optical path; null: always on
#   pulses: null                 # integer >= 1, per histogram; or:
#   exposure_time: 1.0           # s per histogram
#   repetition_rate: 1.1e+7      # 1/s, or frequency in MHz; null: pulses far apart; default null
#   ambient_rate: 0              # 1/s; default 0
#   dark_count_rate: 0           # 1/s; default 0
#   pile_up: none                # none | first_photon | dead_time; default none
#   dead_time_ps: null           # ps, > 0
#   afterpulse_probability: 0    # 0..1; default 0
#   afterpulse_decay_ps: 20000   # ps, or a list; default 20000
#   crosstalk: null              # {{share: 0.1, delay_opl: 0}}
#   zones: null                  # {{nx: 3, ny: 3, width_deg: 41, height_deg: 52}}, or width and height in m
#   shot_noise: true             # false: expected counts; default true
#   seed: 0                      # 0..4294967295; default 0

# Many captures from this file: each key below, by its dotted name, takes all of its values. output.path then needs
# {{index}} or {{index:05d}} in it and may have {{name}}; default {{name}}/{{index:05d}}.hdf5. An index.json lists them.
# sweep:
#   mode: product                # product: every combination | zip: the first values together, the second ones, ...
#   keys:                        # a list of values, or from start to stop, both included: range | log_range
#     capture.sensor_grid.nx: [16, 32]
#     scene.hidden_geometry.0.center.2: {{range: {{start: 0.5, stop: 1.5, n: 5}}}}  # or step: 0.25
#   random:                      # draws, the same for every combination of the keys above
#     count: 20
#     seed: 0                    # 0..4294967295; default 0
#     keys:                      # uniform: [a, b] | log_uniform: [a, b] | integers: [a, b] | choice: [...]
#       scene.hidden_geometry.0.bsdf.reflectance: {{uniform: [0.2, 0.9]}}
#       # also files of a folder, rotations, places, copies of an item, draws inside a value: docs/datasets.md
# dataset:                       # of the captures of a sweep
#   split: {{by: capture, train: 0.8, val: 0.1, test: 0.1, seed: 0}}  # by: capture | file | folder; default null
#   label: null                  # a swept key; default null: the folder of the drawn file, or the letters
#   index: csv                   # csv | parquet, the table beside index.json; default csv
#   format: znlos                # znlos | webdataset | lfe | nlos3d: also a package for training; default znlos
#   shard_size: 1GB              # of webdataset's tar files; default 1GB
#   dtype: float32               # float32 | float16 (webdataset); default float32
#   crop: false                  # webdataset: leave out bins that are dark in all captures; default false
"""


def starter_config(scan_type: ScanType = "confocal", name: str = "capture", file: str = "capture.yaml") -> str:
    """Return the YAML text of a commented starter config.

    Parameters
    ----------
    scan_type
        Scan the starter is written for.
    name
        Name of the capture; letters, digits, dots, dashes and underscores only, others become dashes.
    file
        What the first comment calls the file.
    """
    plain = "".join(character if character.isalnum() or character in "-_." else "-" for character in name)
    readable = plain if plain[:1].isalpha() else f"capture-{plain}"  # 007, .5 and -x are not text in YAML
    if readable.lower() in ("null", "true", "false"):
        readable = f"capture-{readable}"
    one_line = "".join(character for character in file if character.isprintable())
    is_view = scan_type == "line_of_sight"
    grids = _SENSOR_GRID + _LASER_KEYS.get(scan_type, _LASER_KEYS["single"]) + _DEVICES
    bin_width = "0.05" if is_view else "0.003"
    return _TEMPLATE.format(
        name=readable,
        file=one_line,
        scan_type=scan_type,
        pad=" " * (20 - len(scan_type)),
        wall=_commented(_WALL) if is_view else _WALL,
        emitters=_EMITTERS if is_view else _commented(_EMITTERS),
        camera=_CAMERA if is_view else _commented(_CAMERA),
        pixels=_PIXELS,
        grids=_commented(grids) if is_view else grids,
        bin_width=bin_width,
        bin_pad=" " * (16 - len(bin_width)),
    )


def _commented(keys: str) -> str:
    """Put a comment sign before every line that has none."""
    lines = keys.splitlines(keepends=True)
    return "".join(line if line.lstrip().startswith("#") else f"{line[:2]}# {line[2:]}" for line in lines)
