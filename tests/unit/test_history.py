"""The pose at the instant of a frame, from states that came before and after it."""

import numpy as np
import pytest

from lcmtypes import make
from lcmtypes.podwatch import vehicle_state_t
from procs.history import PoseHistory


def state(utime: int, n_m: float, yaw_rad: float, *, position_ok: bool = True) -> vehicle_state_t:
    return make(vehicle_state_t, utime=utime, n_m=n_m, d_m=-30.0, yaw_rad=yaw_rad, position_ok=position_ok)


def test_the_pose_at_a_frame_is_interpolated_the_short_way_across_south() -> None:
    poses = PoseHistory()
    assert poses.at(0) is None
    poses.add(state(1_000_000, 0.0, np.pi - 0.1))
    poses.add(state(1_200_000, 2.0, -np.pi + 0.1))
    middle = poses.at(1_100_000)
    assert middle is not None
    assert middle.n_m == pytest.approx(1.0)
    assert abs(middle.yaw_rad) == pytest.approx(np.pi)


def test_a_state_that_is_late_or_has_no_position_is_passed_over() -> None:
    poses = PoseHistory()
    poses.add(state(1_200_000, 2.0, 0.0))
    poses.add(state(1_100_000, 99.0, 0.0))
    poses.add(state(1_300_000, 99.0, 0.0, position_ok=False))
    pose = poses.at(1_250_000)
    assert pose is not None
    assert pose.n_m == 2.0


def test_a_frame_far_from_every_state_has_no_pose() -> None:
    poses = PoseHistory()
    poses.add(state(1_000_000, 0.0, 0.0))
    poses.add(state(4_000_000, 3.0, 0.0))
    assert poses.at(400_000) is None
    assert poses.at(2_500_000) is None
    assert poses.at(4_600_000) is None
    assert poses.at(4_400_000) is not None
