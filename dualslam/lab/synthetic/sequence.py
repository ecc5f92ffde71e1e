"""A rendered sequence with exact truth: the same interface as a recording, and what no recording has."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.config.corruption import Corruption
from dualslam.core.errors import ConfigError, InputError
from dualslam.core.types import FloatArray, Frame, IntArray
from dualslam.lab.synthetic.circuit import make_circuit, make_eight, make_terrace
from dualslam.lab.synthetic.events import disturbance, parse_events, yaw_offset_rad
from dualslam.lab.synthetic.path import Drive, Walk, pose
from dualslam.lab.synthetic.render import Renderer
from dualslam.lab.synthetic.room import HALF_SIZE_M, make_room
from dualslam.lab.synthetic.sensor import Sensor
from dualslam.lab.synthetic.street import make_street
from dualslam.lab.synthetic.traps import TRAPS, Place
from dualslam.lab.synthetic.twins import TWINS
from dualslam.lab.synthetic.visits import OtherWay, at_another_hour
from dualslam.lab.synthetic.ward import make_ward

if TYPE_CHECKING:
    from dualslam.core.camera.models import PinholeCamera

# A smear of motion blur is the average of images about three pixels apart, within these bounds on their number.
_N_SUBFRAMES = (9, 33)
SCENES = ("street", "room", "circuit", "eight", "terrace", "ward", *TWINS, *TRAPS)
VISITED = ("street", "circuit", "eight")
"""Of these there are later visits."""
AT_10_HZ = ("street", "circuit", "eight", "terrace", "standstill", "ward")
LIMITS = {
    "n_frames": (1, 100_000),
    "seed": (0, 2**63),
    "visit": (0, 1000),
    "backwards": (0, 1),
    "width": (32, 4096),
    "height": (32, 4096),
}


class CameraPath(Protocol):
    """A camera's pose as a smooth function of time."""

    def T_world_cam(self, t_s: float) -> FloatArray:
        """Return the pose (4, 4) at time `t_s`."""
        ...


class SyntheticSequence:
    """Frames rendered when they are asked for. Made by `make_sequence`.

    Any frame can be asked for at any time, and is the same bit for bit whatever was asked for before.

    Attributes
    ----------
    name : str
        The scene and its seed.
    camera : PinholeCamera
    rate_hz : float
    n_frames : int
        Frames recorded, those that an event drops included.
    indices : (N,) int64
        Indices of the frames that arrive: all but the dropped ones.
    timestamps_s : (n_frames,) float64
    ground_truth_T_world_cam : (n_frames, 4, 4) float64
        Camera to world, metres, in the middle of the exposure; row i belongs to the frame with index i.
    events : tuple of Corruption
    parameters : dict
        What `make_sequence` was called with, for the record.
    """

    def __init__(
        self,
        parameters: Mapping[str, Any],
        camera: PinholeCamera,
        path: CameraPath,
        renderer: Renderer,
        sensor: Sensor,
        events: tuple[Corruption, ...],
    ) -> None:
        self.parameters = dict(parameters)
        self.name = f"synthetic_{parameters['scene']}_{parameters['seed']}"
        self.camera = camera
        self.rate_hz = float(parameters["rate_hz"])
        self.n_frames = int(parameters["n_frames"])
        self.events = events
        self._path, self._renderer, self._sensor = path, renderer, sensor
        self.timestamps_s: FloatArray = np.arange(self.n_frames) / self.rate_hz
        kept = [i for i in range(self.n_frames) if not disturbance(events, i).dropped]
        self.indices: IntArray = np.array(kept, np.int64)
        poses = [self._T_world_cam(i) for i in range(self.n_frames)]
        self.ground_truth_T_world_cam: FloatArray = np.stack(poses)

    def __len__(self) -> int:
        return len(self.indices)

    def __iter__(self) -> Iterator[Frame]:
        for index in self.indices:
            yield self.frame(int(index))

    def frame(self, index: int) -> Frame:
        """Render the frame with this index.

        Raises
        ------
        InputError
            Where there is no such frame, or an event drops it.
        """
        self._check(index)
        what = disturbance(self.events, index)
        if what.dropped:
            raise InputError(f"{self.name}: frame {index} is dropped by an event of the script; see `indices`")
        if what.shutter:
            # Averaged in display values, as most cameras' images are used; the truth is the middle of the exposure.
            opened, closed = self._T_world_cam(index - what.shutter / 2), self._T_world_cam(index + what.shutter / 2)
            turn_rad = np.arccos(np.clip(opened[:3, 2] @ closed[:3, 2], -1, 1))
            n_subframes = int(np.clip(turn_rad * self.camera.K[0, 0] / 3, *_N_SUBFRAMES))
            shifts = what.shutter * (np.arange(n_subframes) / (n_subframes - 1) - 0.5)
            total = np.zeros((self.camera.height, self.camera.width), np.float32)
            for shift in shifts:
                cv2.accumulate(self._renderer.image(self._T_world_cam(index + shift)), total)
            scene = np.rint(total / n_subframes).astype(np.uint8)
        else:
            scene = self._renderer.image(self.ground_truth_T_world_cam[index])
        return Frame(index, float(self.timestamps_s[index]), self._sensor.expose(scene, index, what))

    def depth(self, index: int) -> NDArray[np.float32]:
        """Return the true depth z (height, width) at each pixel's centre, metres, inf for the sky.

        Raises
        ------
        InputError
            Where there is no such frame.
        """
        self._check(index)
        return self._renderer.depth(self.ground_truth_T_world_cam[index])

    def points_world(self, index: int, uv_px: FloatArray) -> FloatArray:
        """Return the surface points (N, 3) seen at whole pixels (N, 2) of a frame, world, NaN for the sky."""
        column, row = np.rint(np.asarray(uv_px)).astype(np.int64).T
        z = self.depth(index)[row, column].astype(np.float64)
        rays = np.stack([column, row, np.ones(len(row))], 1) @ np.linalg.inv(self.camera.K).T
        with np.errstate(invalid="ignore"):
            points = np.where(np.isfinite(z)[:, None], rays * z[:, None], np.nan)
        T_world_cam = self.ground_truth_T_world_cam[index]
        return np.asarray(points @ T_world_cam[:3, :3].T + T_world_cam[:3, 3])

    def _check(self, index: int) -> None:
        if not 0 <= index < self.n_frames:
            raise InputError(f"{self.name}: there is no frame {index}; its frames are 0 to {self.n_frames - 1}")

    def _T_world_cam(self, index: float) -> FloatArray:
        """Return the pose at a (fractional) frame."""
        T_world_cam = self._path.T_world_cam(index / self.rate_hz)
        yaw_rad = yaw_offset_rad(self.events, index)
        return T_world_cam @ pose(np.zeros(3), yaw_rad, 0.0, 0.0) if yaw_rad else T_world_cam


def make_sequence(
    scene: str = "street",
    n_frames: int = 300,
    seed: int = 0,
    width: int = 640,
    height: int = 480,
    events: Iterable[Corruption | Mapping[str, Any]] = (),
    rate_hz: float | None = None,
    supersampling: float = 1.5,
    visit: int = 0,
    backwards: int = 0,
) -> SyntheticSequence:
    """Make a world, a way through it, and a camera.

    Parameters
    ----------
    scene : str
        One of `SCENES`. A drive of about 9 m/s between houses, or a hand-held camera in a furnished room. A block of
        houses driven round and round, a figure of eight, and a straight street of identical houses. Two similar
        corridors, and two rooms with the same posters. A hospital ward with white walls.
        `dualslam/lab/synthetic/traps.py` describes the others.
    n_frames : int
    seed : int
        Of the world, the path and the noise: the same seed gives the same images, bit for bit.
    width, height : int
        Image size, pixels. The horizontal field of view does not depend on it.
    events : iterable of Corruption or mapping
        Disturbances of some of the frames.
    rate_hz : float, optional
        Frames a second: 10 on the street and in the ward, 30 in the room and in the hand.
    supersampling : float
        Silhouettes are smoother and rendering slower with more.
    visit : int
        Of a place on wheels: 0, or a later one, with other light, other parked cars, and a drive of its own.
    backwards : int
        1: a closed road is driven the other way round, in the other lane.

    Raises
    ------
    ConfigError
        Where a parameter makes no sense.
    """
    if scene not in SCENES:
        raise ConfigError(f"synthetic scene {scene!r} is unknown; use one of {', '.join(SCENES)}")
    rate_hz = float(rate_hz) if rate_hz is not None else (10.0 if scene in AT_10_HZ else 30.0)
    whole = {"n_frames": n_frames, "seed": seed, "visit": visit, "backwards": backwards, "width": width}
    _check(scene, whole | {"height": height}, rate_hz, supersampling)
    script = parse_events(events)
    place = _place(scene, seed, n_frames / rate_hz, visit, backwards)
    focal, sensor = 0.72, Sensor(seed + (visit << 40), width, height, blur_px=0.45)
    if place.in_hand:
        focal = 0.82
        # A cheap camera in the hand: softer than the one on the car.
        sensor = Sensor(seed, width, height, blur_px=0.9, noise=1.2, stops=0.4)
    camera = _pinhole(focal * width, width, height)
    renderer = Renderer(place.scene, camera.K, width, height, detail=min(1.0, width / 640), supersampling=supersampling)
    parameters = {
        "scene": scene,
        "n_frames": int(n_frames),
        "seed": int(seed),
        "width": int(width),
        "height": int(height),
        "rate_hz": rate_hz,
        "supersampling": float(supersampling),
    }
    parameters |= {name: n for name, n in (("visit", visit), ("backwards", backwards)) if n}
    return SyntheticSequence(parameters, camera, place.path, renderer, sensor, script)


def _check(scene: str, whole: Mapping[str, Any], rate_hz: float, supersampling: float) -> None:
    """Refuse parameters that make no sense; `whole`: those that are whole numbers."""
    for name, value in whole.items():
        low, high = LIMITS[name]
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or not low <= value <= high:
            raise ConfigError(f"synthetic sequence: {name} is {value!r}; it must be a whole number, {low} to {high}")
    if not 0.5 <= rate_hz <= 1000:
        raise ConfigError(f"synthetic sequence: rate_hz is {rate_hz:g}; it must lie between 0.5 and 1000")
    if not 1 <= supersampling <= 4:
        raise ConfigError(f"synthetic sequence: supersampling is {supersampling:g}; it must lie between 1 and 4")
    if (visit := whole["visit"]) and scene not in VISITED:
        raise ConfigError(f"synthetic sequence: visit is {visit!r}; of {scene} there is the first, 0, alone")
    if (backwards := whole["backwards"]) and scene not in ("circuit", "eight"):
        raise ConfigError(f"synthetic sequence: backwards is {backwards!r}; it may be 1 in a circuit or an eight")


def _place(scene: str, seed: int, duration_s: float, visit: int, backwards: int) -> Place:
    """Make a world and a way through it."""
    rng = np.random.default_rng([seed, 0xCA4, visit] if visit else [seed, 0xCA4])
    if scene in TWINS:
        world, path = TWINS[scene](seed)
        return Place(world, path, in_hand=True)
    if scene == "ward":
        return make_ward(seed, duration_s)
    if scene in TRAPS:
        return TRAPS[scene](seed, duration_s)
    if scene == "room":
        world = make_room(seed)
        return Place(world, Walk(rng, duration_s, (HALF_SIZE_M[0] - 1.3, HALF_SIZE_M[1] - 1.3)), in_hand=True)
    length_m = 10.0 * duration_s + 30
    if scene == "circuit":
        world, road = make_circuit(seed)
    elif scene == "eight":
        world, road = make_eight(seed)
    elif scene == "terrace":
        world, road = make_terrace(seed, length_m)
    else:
        world, road = make_street(seed, length_m)
    drive = Drive(OtherWay(road) if backwards else road, rng, duration_s, speed_m_s=10.0)
    return Place(at_another_hour(world, visit), drive, in_hand=False)


def _pinhole(focal_px: float, width: int, height: int) -> PinholeCamera:
    """Return a camera with square pixels and the principal point in the middle of the image."""
    from dualslam.core.camera.models import PinholeCamera

    return PinholeCamera(width=width, height=height, fx=focal_px, fy=focal_px, cx=(width - 1) / 2, cy=(height - 1) / 2)
