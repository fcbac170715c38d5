# SPDX-License-Identifier: Apache-2.0
"""One 2D⇔3D block: ray-traced attention both ways, skips, convolutional feed-forward (RayTran §3.1)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Literal

from torch import Tensor, nn

from raytran.norms import LayerNorm
from raytran.ops.pairs import Pairs
from raytran.ops.ray_attention import Direction, ray_attention_in_chunks


class RayTracedBlock(nn.Module):
    """Mixes pixel features into voxels and voxel features into pixels.

    The two streams are parallel: both read the features that enter the block. Layer normalisation comes
    before attention and feed-forward, whose results are added to the stream.

    A view's pixels attend to voxels alone, so they need no other view, and chunks of views change nothing for
    them. A voxel attends to the pixels of all views: its softmax is joined from those over each chunk.

    Args:
        channels: C of both streams.
        num_heads: attention heads.
        expansion: hidden channels of the feed-forward, as a multiple of C.
    """

    def __init__(self, *, channels: int = 256, num_heads: int = 8, expansion: int = 2) -> None:
        super().__init__()
        self.voxel_norm = LayerNorm(channels)
        self.pixel_norm = LayerNorm(channels)
        self.voxel_stream = Stream(
            channels=channels, num_heads=num_heads, expansion=expansion, direction="pixels_to_voxels"
        )
        self.pixel_stream = Stream(
            channels=channels, num_heads=num_heads, expansion=expansion, direction="voxels_to_pixels"
        )

    def forward(
        self, voxels: Tensor, pixels: Sequence[Tensor], pairs: Sequence[Pairs], *, update_pixels: bool = True
    ) -> tuple[Tensor, list[Tensor]]:
        """Return the two representations after the block.

        Args:
            voxels: ``(B, X, Y, Z, C)``.
            pixels: of each chunk of views ``(n, h, w, C)`` with n = B · N.
            pairs: of each chunk, the pixel-voxel pairs of all scenes.
            update_pixels: False returns ``pixels`` unchanged (the last block, where nothing reads them).

        Returns:
            voxels ``(B, X, Y, Z, C)`` and the pixels ``(n, h, w, C)`` of each chunk.
        """
        voxel_input = self.voxel_norm(voxels)
        pixel_inputs = [self.pixel_norm(features) for features in pixels]
        # Keys and values of a chunk are made when they are read: those of one chunk are in memory at a time.
        keys_and_values = (self.voxel_stream.keys_and_values(source) for source in pixel_inputs)
        new_voxels = self.voxel_stream(voxels, voxel_input, keys_and_values, pairs)
        if not update_pixels:
            return new_voxels, list(pixels)
        of_voxels = self.pixel_stream.keys_and_values(voxel_input)
        new_pixels = [
            self.pixel_stream(features, target, [of_voxels], [of_chunk])
            for features, target, of_chunk in zip(pixels, pixel_inputs, pairs, strict=True)
        ]
        return new_voxels, new_pixels


class Stream(nn.Module):
    """One direction of a block: target features attend to source features along the rays.

    Args:
        channels: C.
        num_heads: attention heads.
        expansion: hidden channels of the feed-forward, as a multiple of C.
        direction: which representation is the target; decides between 3D and 2D convolutions.
    """

    def __init__(self, *, channels: int, num_heads: int, expansion: int, direction: Direction) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.direction: Direction = direction
        self.query = nn.Linear(channels, channels)
        self.key = nn.Linear(channels, channels, bias=False)  # a key bias cancels in the softmax
        self.value = nn.Linear(channels, channels)
        self.output = nn.Linear(channels, channels)
        self.norm = LayerNorm(channels)
        dimensions: Literal[2, 3] = 3 if direction == "pixels_to_voxels" else 2
        self.feed_forward = ConvFeedForward(
            channels=channels, hidden=expansion * channels, dimensions=dimensions
        )

    def forward(
        self,
        stream: Tensor,
        target: Tensor,
        keys_and_values: Iterable[tuple[Tensor, Tensor]],
        pairs: Sequence[Pairs],
    ) -> Tensor:
        """Return the stream after attention and feed-forward.

        Args:
            stream: ``(n, ..., C)`` un-normalised target features, to which results are added.
            target: ``(n, ..., C)`` the same, normalised: the queries.
            keys_and_values: of each chunk of the sources, see ``keys_and_values``.
            pairs: of each chunk, the pixel-voxel pairs.

        Returns:
            ``(n, ..., C)``.
        """
        query = self._split_heads(self.query(target))
        attended = ray_attention_in_chunks(query, keys_and_values, pairs, direction=self.direction)
        stream = stream + self.output(attended.flatten(1)).view(stream.shape)
        return stream + self.feed_forward(self.norm(stream))

    def keys_and_values(self, source: Tensor) -> tuple[Tensor, Tensor]:
        """Return keys and values ``(S, H, D)`` of normalised source features ``(m, ..., C)``."""
        return self._split_heads(self.key(source)), self._split_heads(self.value(source))

    def _split_heads(self, x: Tensor) -> Tensor:
        """Map ``(n, ..., C)`` to ``(T, H, D)``."""
        return x.reshape(-1, self.num_heads, x.shape[-1] // self.num_heads)


class ConvFeedForward(nn.Module):
    """A 3×3(×3) convolution, GELU, and a linear layer back to C, on channels-last features."""

    def __init__(self, *, channels: int, hidden: int, dimensions: Literal[2, 3]) -> None:
        super().__init__()
        convolution = nn.Conv2d if dimensions == 2 else nn.Conv3d
        self.convolution = convolution(channels, hidden, 3, padding=1)
        self.activation = nn.GELU()
        self.output = nn.Linear(hidden, channels)

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(n, ..., C)`` to ``(n, ..., C)``."""
        hidden = self.convolution(x.movedim(-1, 1)).movedim(1, -1)
        return self.output(self.activation(hidden))
