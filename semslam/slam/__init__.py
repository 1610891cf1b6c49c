"""Where the robot was and what stands where: estimators turn observations and motion into poses, evidence into a map.

`estimator` says what an estimator is, `registry` opens one by name; `paper` holds the equations as pure functions,
`surfel`, `orb`, `paper_estimator` and `dead_reckoning` are estimators; `evidence` is the map that users get from any
pose track, `render` its picture.
"""
