#!/usr/bin/env bash
# nibabel and SimpleITK place a NIfTI whose sform and qform codes are both 0 differently: nibabel reverses the first
# axis and centres the grid, SimpleITK leaves the axes as they are in the file, from 0 on. In SimpleITK's world (left,
# back, head), y is mirrored between the two. jaxvol follows SimpleITK. Seen with nibabel 5.4.2 and SimpleITK 2.5.7:
#   nibabel, as LPS: first voxel [-3.0, 6.0, -10.0], y axis [0.0, -1.0, 0.0]
#   SimpleITK:       first voxel [0.0, 0.0, 0.0], y axis [0.0, 1.0, 0.0]
# Runs without jaxvol; fails if either changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install -q nibabel==5.4.2 SimpleITK==2.5.7
"$folder/env/bin/python" - "$folder" <<'PYTHON'
import sys

import nibabel
import numpy as np
import SimpleITK

path = f"{sys.argv[1]}/a.nii"
image = nibabel.Nifti1Image(np.zeros((4, 5, 6), np.int16), np.diag([2.0, 3, 4, 1]))
image.set_sform(None, 0)
image.set_qform(None, 0)
nibabel.save(image, path)
affine = np.diag([-1.0, -1, 1, 1]) @ nibabel.load(path).affine
theirs = affine[:3, 3].tolist(), (affine[:3, 1] / 3).tolist()
other = SimpleITK.ReadImage(path)
itk = list(other.GetOrigin()), list(other.GetDirection()[1::3])
print("nibabel, as LPS: first voxel", theirs[0], "y axis", theirs[1])
print("SimpleITK:       first voxel", itk[0], "y axis", itk[1])
assert theirs == ([-3.0, 6.0, -10.0], [0.0, -1.0, 0.0]), "nibabel changed"
assert itk == ([0.0, 0.0, 0.0], [0.0, 1.0, 0.0]), "SimpleITK changed"
PYTHON
