"""The fleet file that `podwatch fleet new` writes: every value that people change, each with its reason."""

__all__ = ["fleet_text"]

RADIO_PORT = 14600
HOME_SPACING_M = 10.0
HOMES_IN_A_ROW = 10  # eastwards; the next row south of it, so that every home lies well inside the fence

HEAD = """\
# The fleet "{name}": the same file on every drone and on the boat.
# All distances in metres, north and east of the fleet's origin; heights above the water.
# A key that is wrong is refused with the nearest right one: podwatch fleet check {file}

name = "{name}"

[origin]                     # n = e = 0 of every position here: the take-off place, as decimal degrees
latitude_deg = 15.30
longitude_deg = -61.50
altitude_m = 0.0             # of the water above mean sea level

[search]                     # where people think the pod may be
start = "operator"           # nobody flies before the boat says `start`; "auto": each as soon as it is ready
north_m = 100.0
east_m = 0.0
height_m = 40.0
speed_m_s = 6.0
radius_m = 150.0             # of the spiral; it must lie inside the fence

[watch]
watch_s = 300.0              # time over the animals before the fleet returns
height_m = 30.0              # over the own animal: your permit says how low
separation_m = 8.0           # between neighbours while they gather
animal_length_m = 10.0       # of a grown animal of this species

[limits]                     # what no drone exceeds, whatever else asks for it
speed_m_s = 10.0
min_height_m = 10.0
max_height_m = 80.0
fence_radius_m = 600.0       # of the circle round the origin
battery_return = 0.25        # share of the charge at which a drone goes home
battery_land = 0.10          # and at which it lands where it is

[camera]                     # alike on every drone, looking straight down, the top of the picture at the nose
width_px = 640
height_px = 480
vfov_deg = 60.0              # vertical field of view, as calibrated
rate_hz = 20.0

[radio]
key_file = "fleet.key"       # beside this file on every machine; make it with: podwatch fleet keys {file}
bytes_per_s = 6000           # cap for each link

[log]
quota_gb = 16.0              # above it the oldest pictures go first

[boat]
radio = "10.76.0.100:{port}"  # where the drones reach the boat
lost_return_s = 0.0          # silent for so long, the boat is lost and the fleet comes home; 0: it flies on
"""

DRONE = """
[[drones]]
id = {id:<2}                      # its autopilot's MAV_SYSID too
home_n_m = {home_n_m:<6.1f}            # where it stands before take-off: 3 m or more from the others
home_e_m = {home_e_m:.1f}
[drones.machine]
radio = "10.76.0.{id}:{port}"    # where the others reach this drone
autopilot = "serial:/dev/ttyAMA0:921600"  # or udp:HOST:PORT (listens), udpout:HOST:PORT, tcp:HOST:PORT
camera = "v4l2:/dev/video0"  # or ffmpeg:rtsp://..., pictures:FOLDER (bench), gstreamer:... (not pip's OpenCV)
"""


def fleet_text(name: str, file: str, n_drones: int) -> str:
    """A fleet file of `n_drones` drones, ids from 1."""
    drones = (_drone(k) for k in range(n_drones))
    return HEAD.format(name=name, file=file, port=RADIO_PORT) + "".join(drones)


def _drone(rank: int) -> str:
    row, column = divmod(rank, HOMES_IN_A_ROW)
    home = {"home_n_m": -HOME_SPACING_M * row or 0.0, "home_e_m": HOME_SPACING_M * column}
    return DRONE.format(id=rank + 1, port=RADIO_PORT, **home)
