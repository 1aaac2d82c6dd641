"""From a folder of images and robot poses to X, its uncertainty and a picture: `hand_eye.py FOLDER`."""

import sys

import numpy as np

import calibrate

solved = calibrate.solve(*calibrate.read_folder(sys.argv[1]))
np.set_printoptions(suppress=True, precision=6)
print("camera in the robot's frame, metres:", solved.X, sep="\n")
print("1σ of x y z, mm:", 1e3 * np.sqrt(np.diag(solved.covariance())[:3]))
for number, miss in solved.residuals_px.items():
    print(f"picture {number}: {np.sqrt((miss**2).sum(axis=1).mean()):.2f} px")
print(*(gate.text for gate in solved.gates), sep="\n")
solved.plot().savefig("residuals.png")
