"""Volumes that need not fit into memory: `jaxvol.render_bricks`, sources from which boxes of voxels are read
(`source_of`, `levels_of`), and the overlap of bricks with curved faces (`overlap_of`)."""

from .grid import BrickGrid as BrickGrid, overlap_of as overlap_of
from .opening import level_for as level_for, levels_of as levels_of, source_of as source_of
from .render import render_bricks as render_bricks
from .sources import VoxelSource as VoxelSource
