"""The robot and its home as a MuJoCo model: two driven wheels, a caster, a mast; furniture as walls along its outline.

Units are SI. Furniture needs no inside: a robot that cannot pass the outline never gets there.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from semslam.sim.home import Array, Home
from semslam.sim.outlook import fixture_top
from semslam.sim.space import stops_robot

WHEEL_RADIUS_M = 0.033
TRACK_M = 0.16
STEP_S = 0.0025
"""Of the physics: half a sample of the IMU."""
GRAVITY_M_S2 = 9.81
OBSTACLE_M = 0.01
"""Thickness of what stands along an outline."""
FLOOR_GEOM = 0
"""Id of the floor among the geoms; everything of the home comes after it, the robot last."""


def model_xml(home: Home, imu_m: tuple[float, float, float], camera_height_m: float) -> str:
    """The model of the robot in its home, standing at the origin."""
    return f"""
<mujoco model="home">
  <compiler angle="radian"/>
  <option timestep="{STEP_S}" gravity="0 0 {-GRAVITY_M_S2}" integrator="implicitfast" cone="elliptic"/>
  <default>
    <geom solref="0.02 1"/>
    <default class="obstacle"><geom contype="2" conaffinity="0" friction="0.3"/></default>
    <default class="robot"><geom contype="0" conaffinity="3" condim="4" friction="0.7 0.01 0.0001"/></default>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1" contype="1" conaffinity="0" friction="0.7 0.01 0.0001"/>
{obstacles_xml(home)}
{_robot_xml(imu_m, camera_height_m)}
  </worldbody>
  <actuator>
    <velocity name="left" joint="left" kv="0.1" forcerange="-0.4 0.4"/>
    <velocity name="right" joint="right" kv="0.1" forcerange="-0.4 0.4"/>
  </actuator>
  <sensor>
    <gyro name="gyro" site="imu"/>
    <accelerometer name="accel" site="imu"/>
  </sensor>
</mujoco>"""


def _robot_xml(imu_m: tuple[float, float, float], camera_height_m: float) -> str:
    """A body whose frame is base_link: on the floor, between the wheels.

    The caster is a ball that rolls in its cup, so it has no friction; a dragged one stutters at 70 Hz.
    """
    mast = camera_height_m - 0.1
    return f"""
    <body name="base" childclass="robot">
      <freejoint/>
      <geom type="box" size="0.07 0.065 0.035" pos="-0.028 0 0.055" mass="1.15"/>
      <geom type="cylinder" size="0.007 {mast / 2:.6f}" pos="-0.03 0 {0.09 + mast / 2:.6f}" mass="0.1"/>
      <geom type="box" size="0.015 0.045 0.015" pos="-0.01 0 {camera_height_m:.6f}" mass="0.07"/>
      <geom type="sphere" size="0.012" pos="-0.085 0 0.012" mass="0.02" condim="1" priority="1"/>
      <site name="imu" pos="{imu_m[0]:.6f} {imu_m[1]:.6f} {imu_m[2]:.6f}"/>
{_wheel_xml("left", TRACK_M / 2)}
{_wheel_xml("right", -TRACK_M / 2)}
    </body>"""


def _wheel_xml(name: str, left_m: float) -> str:
    """A wheel with a round tyre: a cylinder's contacts jump from edge to edge and shake the accelerometer."""
    return f"""
      <body name="{name}_wheel" pos="0 {left_m} {WHEEL_RADIUS_M}">
        <joint name="{name}" type="hinge" axis="0 1 0" armature="0.0005" damping="0.001"/>
        <geom type="ellipsoid" size="{WHEEL_RADIUS_M} 0.012 {WHEEL_RADIUS_M}" mass="0.05"/>
      </body>"""


def obstacles_xml(home: Home) -> str:
    """Walls along the outlines of everything that can be bumped into, and around the home."""
    outlines = [(np.asarray(item.footprint), fixture_top(home, item)) for item in home.fixtures if stops_robot(item)]
    outlines += [(item.footprint, item.z_m + item.piece.height_m) for item in home.objects]
    outlines += [(fence, home.height_m) for fence in _fences(home)]
    return "\n".join(_edge_xml(a, b, top) for line, top in outlines for a, b in _edges(_simplified(line)))


def _fences(home: Home) -> list[Array]:
    """The border of the union of the home's polygons, found on a raster fine enough for a robot."""
    cell_m = 0.02
    x0, y0, x1, y1 = home.bounds
    shape = round((y1 - y0) / cell_m) + 5, round((x1 - x0) / cell_m) + 5
    floor = np.zeros(shape, np.uint8)
    for polygon in home.outline:
        cells = np.round((polygon - (x0, y0)) / cell_m).astype(np.int32) + 2
        cv2.fillPoly(floor, [cells], 1)
    borders, _ = cv2.findContours(floor, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    return [np.asarray(border[:, 0] - 2, np.float64) * cell_m + (x0, y0) for border in borders if len(border) > 2]


def _simplified(outline: Array) -> Array:
    """The outline within 5 mm, with fewer corners."""
    fewer = cv2.approxPolyDP(outline.astype(np.float32)[:, None], 0.005, True)[:, 0]
    return np.asarray(fewer, np.float64) if len(fewer) > 2 else outline


def _edges(outline: Array) -> list[tuple[Array, Array]]:
    """Sides of a polygon that are long enough for a box."""
    sides = zip(outline, np.roll(outline, -1, axis=0), strict=True)
    return [(a, b) for a, b in sides if math.dist(a, b) > 1e-3]


def _edge_xml(a: Array, b: Array, top_m: float) -> str:
    x, y = (a + b) / 2
    length, yaw, top = math.dist(a, b), math.atan2(b[1] - a[1], b[0] - a[0]), max(top_m, 0.05)
    return (
        f'    <geom class="obstacle" type="box" size="{length / 2:.6f} {OBSTACLE_M / 2} {top / 2:.6f}" '
        f'pos="{x:.6f} {y:.6f} {top / 2:.6f}" euler="0 0 {yaw:.6f}"/>'
    )
