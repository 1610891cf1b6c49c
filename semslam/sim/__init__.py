"""Simulated homes that record ordinary MCAP logs with exact truth: for training, for comparisons, for the demo.

One noun a file. What there is: `home` (the data types), `shapes` and `textures`, `furniture/` (pieces), `shell`,
`building`, `hangings`, `fittings`, `clutter`, `palettes`, `lighting` (the building and what lies about), `groups`,
`zones`, `furnish`, `changes`, `walk`, `space`, `polygons` and `layout` (where things stand; `make_home`), `plan` (the
picture of it). Who moves: `chassis` and `vehicle` (physics), `outlook`, `lattice` and `route` (where to go), `inertial`
(IMU and wheels). What is seen: `eye`, `boxes`, `sensors`. What is written: `log`, `truth`, `recorder` (one log), and
`dataset`, `dataset_folder`, `simulate`, `pool`, `splits` (many), on `engine` (the packages of the extra `[sim]`).

Frame `world`: origin on the floor near the middle of the home, z up; metres.
"""
