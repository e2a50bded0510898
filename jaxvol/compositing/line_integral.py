"""Line integral of the extinction: X-ray images, digitally reconstructed radiographs, and tomography."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._util.vec3 import Color, Scalar, Vec3
from ..march.march import March
from ..scene.occupancy import Blocks
from ..scene.several import Together
from ..scene.transfer import Classification, Classify, Measured, Transfer
from ..scene.volume import Volume
from .blending import OpticalDepths


SCALE = 2.0**-20
"""Factor of the extinction: in float32, an opacity near 1 does not resolve the optical depth. Exact, as a
power of 2."""


class LineIntegral(OpticalDepths):
    """The line integral of the extinction along a ray, ∫ μ ds: an X-ray image.

    The colours of `Rendering.rgba` are the transfer function's, integrated with the extinction: for white,
    each channel is the line integral, without an upper limit, and so is `Rendering.image` over black. The
    opacity is the absorbed fraction of the intensity, 1 - exp(-∫ μ ds), so that `1 - rgba[..., 3]` is I / I₀
    of Beer and Lambert. `Rendering.depth` is the mean depth of the attenuation.

    With `AlphaCorrection`, the integral of an extinction that is linear along the ray is exact up to rounding
    under `"midpoint"`, and gradients are complete, at any optical depth. Rays leap over transparent blocks;
    nothing ends them early. `jaxvol.attenuation` is a transfer function for CT. The camera is the X-ray
    source. X-rays have one energy and do not scatter.

    A volume ends at its outer nodes. Programs with box-shaped voxels see half a voxel more at each face, so
    that their integrals are larger where a face cuts matter; with a voxel of air around, they agree.

    Source: Beer and Lambert, as in Siddon 1985, whose voxels are constant; here, values are interpolated.

    Raises:
        ValueError: in a render, for a lighting.
    """

    def marched(self, transfer: Transfer, march: March, volume: Volume) -> tuple[Transfer, March]:
        if isinstance(transfer, Together):  # it is differentiable where nothing is visible
            return Together(tuple(map(_Thinner, transfer.transfers)), transfer.counts), march
        return _Thinner(transfer), march

    @property
    def resolves_transparent(self) -> bool:
        return True

    def resolved(self, classification: Classification, sums: Float[Array, " n"]) -> Float[Array, " m"]:
        sums = sums / SCALE
        opacity = len(sums) - 1
        return sums.at[opacity].set(-jnp.expm1(-sums[opacity]))


class _Thinner(Transfer):
    """A transfer function whose extinction is multiplied by `SCALE`."""

    transfer: Transfer

    def classifier(self) -> Classify:
        return _thinner(self.transfer.classifier())

    def integrator(self) -> Classify | None:
        integrate = self.transfer.integrator()
        return None if integrate is None else _thinner(integrate)

    def attributes(self, volume: Volume, coordinate: Vec3) -> Measured:
        return self.transfer.attributes(volume, coordinate)

    @property
    def bands(self) -> int | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.transfer.bands

    @property
    def channels(self) -> int | None:
        return self.transfer.channels

    @property
    def reads_more(self) -> bool:
        return self.transfer.reads_more

    @property
    def reads_gradient(self) -> bool:
        return self.transfer.reads_gradient

    def majorant(self, blocks: Blocks) -> Float[Array, "bx by bz"]:
        return SCALE * self.transfer.majorant(blocks)

    def visible(self, blocks: Blocks) -> Bool[Array, "bx by bz"]:
        return self.transfer.visible(blocks)

    def search(self) -> Callable[[Measured], Measured] | None:
        return self.transfer.search()

    def vjp(
        self, measured: Measured, color: Color, extinction: Scalar, *, integrated: bool = False
    ) -> tuple[Transfer, Measured]:
        transfer, values = self.transfer.vjp(measured, color, SCALE * extinction, integrated=integrated)
        return _Thinner(transfer), values


def _thinner(classify: Classify) -> Classify:
    def thinner(measured: Measured) -> tuple[Color, Scalar]:
        color, extinction = classify(measured)
        return color, SCALE * extinction

    return thinner
