"""How much matter does a ray pass? X-ray images, digitally reconstructed radiographs, and tomography."""

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
"""Factor of the extinction: an opacity near 1 hides the depth in float32; a power of 2 is exact."""


class LineIntegral(OpticalDepths):
    """The line integral of the extinction along a ray, ∫ μ ds: an X-ray image.

    The colours of `Rendering.rgba` are those of the transfer function, integrated with the extinction: with
    white, each channel is the line integral itself, without an upper limit. The opacity is the absorbed share
    of the intensity, 1 - exp(-∫ μ ds), so that `1 - rgba[..., 3]` is I / I₀ of Beer and Lambert. Over black,
    `Rendering.image` is the line integral. `Rendering.depth` is the mean depth of what attenuates.

    With `AlphaCorrection`, the integral of an extinction that is linear along the ray is exact but for
    rounding under `"midpoint"`, and gradients are complete, at any optical depth. Rays leap over what is
    transparent; nothing ends them early. A transfer function of CT: `jaxvol.attenuation`. The camera stands
    where the source is. X-rays have one energy here, and do not scatter.

    A volume ends at its outer nodes. Programs whose voxels are boxes see half a voxel more at each face, so
    that where a face cuts matter, their integrals are larger; with a voxel of air around, they agree.

    Source: Beer and Lambert, as in Siddon 1985, whose voxels are constant; here, values are interpolated.

    Raises:
        ValueError: in a render, for a lighting.
    """

    def marched(self, transfer: Transfer, march: March, volume: Volume) -> tuple[Transfer, March]:
        if isinstance(transfer, Together):  # which knows how to be differentiated where nothing is visible
            return Together(tuple(map(_Thinner, transfer.transfers)), transfer.counts), march
        return _Thinner(transfer), march

    @property
    def resolves_transparent(self) -> bool:
        return True

    def resolved(self, classification: Classification, sums: Float[Array, " n"]) -> Float[Array, " m"]:
        whole = sums / SCALE
        opacity = len(whole) - 1
        return whole.at[opacity].set(-jnp.expm1(-whole[opacity]))


class _Thinner(Transfer):
    """A transfer function whose extinction is so much less."""

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
        of = self.transfer.vjp(measured, color, SCALE * extinction, integrated=integrated)
        return _Thinner(of[0]), of[1]


def _thinner(classify: Classify) -> Classify:
    def thinner(measured: Measured) -> tuple[Color, Scalar]:
        color, extinction = classify(measured)
        return color, SCALE * extinction

    return thinner
