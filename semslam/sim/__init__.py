"""Small simulated rooms that record ordinary MCAP logs: for `semslam demo` and for tests that need exact truth.

One noun a file: `furniture` (solids of one piece), `toyroom` (a layout), `texture` (what surfaces look like), `casting`
(where rays meet them), `shading` (their colour in the light), `render` (whole pictures), `robot` (path, IMU, wheels,
depth noise), `recording` (all of it as a log), `demo` (the log and the settings of `semslam demo`).

Frame `room`: origin on the floor in the middle of the room, x and y along the walls, z up; metres.
"""
