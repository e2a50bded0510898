#!/usr/bin/env bash
# vtkStructuredPointsWriter writes unsigned 8-bit scalars in ASCII as COLOR_SCALARS, fractions of 255 with six digits,
# and no other type so: a reader that takes the text as numbers gets 0 everywhere. Seen with vtk 9.7.2:
#   unsigned char: COLOR_SCALARS scalars 1, 0.027451
#   short:         SCALARS scalars short, 7
# Runs without jaxvol; fails if it changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install -q vtk==9.7.2
"$folder/env/bin/python" - "$folder" <<'PYTHON'
import sys

import numpy as np
import vtk
from vtk.util.numpy_support import numpy_to_vtk

told = {}
for name, kind in (("unsigned char", np.uint8), ("short", np.int16)):
    image = vtk.vtkImageData()
    image.SetDimensions(2, 2, 2)
    image.GetPointData().SetScalars(numpy_to_vtk(np.full(8, 7, kind), deep=True))
    writer = vtk.vtkStructuredPointsWriter()
    writer.SetFileName(f"{sys.argv[1]}/a.vtk")
    writer.SetInputData(image)
    writer.SetFileTypeToASCII()
    writer.Write()
    lines = open(f"{sys.argv[1]}/a.vtk").read().split("POINT_DATA 8\n")[1].splitlines()
    told[name] = lines[0].strip(), lines[-1].split()[0]
    print(name, *told[name])
assert told["unsigned char"] == ("COLOR_SCALARS scalars 1", "0.027451"), "vtk changed"
assert told["short"] == ("SCALARS scalars short", "7"), "vtk changed"
PYTHON
