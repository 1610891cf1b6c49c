"""Keypoint SLAM on colour and depth, after ORB-SLAM2 (Mur-Artal and Tardos, 2017), as a baseline."""
