"""The multi-branch denoising U-Net (appendix: The Multi-Branch U-Net): a plain diffusers U-Net with cross-view blocks.

Every view is a branch of the one set of weights. Source branches (images that are there: clean, t = 0) read each other;
target branches (noisy, t) read sources and targets. So the sources' keys and values do not depend on the step: they are
computed once (``read_sources``) and held while the targets are denoised.

A ``CrossViewAttention`` follows each of the U-Net's encoder blocks, its middle block and its decoder blocks, before
their resamplers: for Stable Diffusion widths (320, 640, 1280, 1280), 1280, (1280, 1280, 640, 320). Models for a CPU
leave it out of the finest level. The U-Net is loaded first and composed with them afterwards: with their
zero-initialised outputs it computes exactly what it did before.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import nn
from torch.utils.checkpoint import checkpoint

from arbiview_aug.errors import GeneratorError
from arbiview_aug.generator.attention import CrossViewAttention
from arbiview_aug.generator.conditioning import PoseContext, Views, input_channels
from arbiview_aug.generator.correspondence import LEVELS, TokenWindow

TIMESTEPS = 1000
"""Diffusion steps while training (Sec. Training Parameters)."""

REGRESSION = TIMESTEPS
"""The time at which the denoiser predicts x0 in one step, from the pre-filled latent instead of a noisy one."""

_BLOCKS = ("DownBlock2D", "CrossAttnDownBlock2D", "UNetMidBlock2DCrossAttn", "UpBlock2D", "CrossAttnUpBlock2D")

_UNUSED = (
    "class_embed_type",
    "addition_embed_type",
    "encoder_hid_dim",
    "time_cond_proj_dim",
    "time_embedding_act_fn",
    "center_input_sample",
)

KeysValues = tuple[torch.Tensor, torch.Tensor]


Sources = list[KeysValues]
"""What targets read of S source branches: (B, S, T, width) twice for each cross-view block, in the order they run."""


class Rows(NamedTuple):
    """The attention maps of one block that L_geo compares, over the 3 x 3 taps of the E valid (token, pair, level).

    Attributes:
        predicted: (E, 9) M_ij^pred.
        target: (E, 9) M_ij^target, bilinear weights at H p_i.
        pair: (E,) int64 which pair (i, j) a row belongs to.
    """

    predicted: torch.Tensor
    target: torch.Tensor
    pair: torch.Tensor


class Lacking(NamedTuple):
    """What the condition lacks of the image, in its own units: see ``Denoiser._lacking``.

    Attributes:
        given: (B, N, C, h, w) float32 z, what the network sees of x_t.
        linear: (B, N, C, h, w) v of the linear guess.
        scale: (B, N, 1, h, w) what the network's output counts in v.
    """

    given: torch.Tensor
    linear: torch.Tensor
    scale: torch.Tensor


class Denoiser(nn.Module):
    """ε_θ(x_t, t, f_pose) for N target views at once, and x0 in one step at t = ``REGRESSION``.

    Args:
        unet: A diffusers ``UNet2DConditionModel``; its ``conv_in`` is widened, with zeros, to the conditions.
        levels: Depth levels of the attention.
        prompt_tokens: Tokens of the empty prompt's embedding.
        cross_view: For each level, the finest first, whether views read each other there; at all where empty.
        signal: (T,) sqrt of the schedule's ᾱ_t: the network then sees and predicts what the condition lacks
            of the image; None leaves its output as it is, as Stable Diffusion's weights need.

    Attributes:
        deviation: (2,) standard deviation of what the condition lacks, inside the holes and outside; measured before
            training.
        cross_view: The cross-view blocks by their place among the U-Net's encoder blocks, its middle block and its
            decoder blocks.
        gradient_checkpointing: Recompute blocks in the backward pass instead of holding them.
    """

    deviation: torch.Tensor

    def __init__(
        self,
        unet: Any,
        levels: int = len(LEVELS),
        prompt_tokens: int = 0,
        cross_view: Sequence[bool] = (),
        signal: torch.Tensor | None = None,
    ) -> None:
        super().__init__()
        check_unet(unet)
        self.latent_channels = int(unet.config.out_channels)
        widen(unet, input_channels(self.latent_channels))
        self.unet = unet
        widths = tuple(unet.config.block_out_channels)
        there = tuple(cross_view) or (True,) * len(widths)
        places = zip((*widths, widths[-1], *widths[::-1]), (*there, there[-1], *there[::-1]), strict=True)
        self.cross_view = nn.ModuleDict(
            {str(k): CrossViewAttention(width, levels) for k, (width, used) in enumerate(places) if used}
        )
        self.context = PoseContext(int(unet.config.cross_attention_dim), prompt_tokens)
        self.regression = nn.Conv2d(widths[0], self.latent_channels, 3, padding=1)
        nn.init.zeros_(self.regression.weight)
        nn.init.zeros_(self.regression.bias)  # type: ignore[arg-type]
        self.gradient_checkpointing = False
        self.signal = signal  # no buffer: half precision would round it
        if signal is not None:
            self.register_buffer("deviation", torch.tensor([0.3, 0.1]))
            nn.init.zeros_(unet.conv_out.weight)
            nn.init.zeros_(unet.conv_out.bias)

    @property
    def token_levels(self) -> int:
        """How many token grids there are, see ``correspondence.token_sizes``."""
        return len(self.unet.config.block_out_channels)

    @property
    def dtype(self) -> torch.dtype:
        """Of the weights."""
        return self.unet.conv_in.weight.dtype

    def own_parameters(self) -> list[nn.Parameter]:
        """What is trained beside a frozen U-Net: attention, pose, the widened ``conv_in``, the one-step head."""
        parts = (self.cross_view, self.context, self.regression, self.unet.conv_in)
        return [parameter for part in parts for parameter in part.parameters()]

    def read_sources(self, sources: Views, windows: Sequence[TokenWindow]) -> Sources:
        """Run the source branches; sources read sources only.

        Args:
            sources: Conditions of S views; their latents are clean.
            windows: Of the sources in the sources, one for each token grid, the finest first.
        """
        count = sources.latent.shape[:2]
        t = torch.zeros(count, dtype=torch.long, device=sources.latent.device)
        read: Sources = []
        clean = sources.latent if self.signal is None else torch.zeros_like(sources.latent)  # they lack nothing
        self._run(clean, t, sources, windows, None, read, None)
        return read

    def forward(
        self,
        noisy: torch.Tensor,
        t: torch.Tensor,
        targets: Views,
        windows: Sequence[TokenWindow],
        sources: Sources,
        rows: list[Rows] | None = None,
    ) -> torch.Tensor:
        """The prediction for N target views of B frames.

        Args:
            noisy: (B, N, C, h, w) x_t; where t is ``REGRESSION`` the pre-filled latent.
            t: (B,) or (B, N) int64 in [0, ``REGRESSION``].
            targets: Their conditions.
            windows: Of the targets in [sources, targets], one for each token grid, the finest first.
            sources: From ``read_sources``.
            rows: A list to append L_geo's rows to, one entry a block.

        Returns:
            (B, N, C, h, w): what the schedule predicts (ε or v); x0 where t is ``REGRESSION``.
        """
        t = t[:, None].expand(noisy.shape[:2]) if t.dim() == 1 else t
        at_once = (t == REGRESSION)[:, :, None, None, None]
        given = noisy
        if self.signal is not None:
            lacking = self._lacking(noisy, t, targets)
            given = lacking.given.masked_fill(at_once, 0)
        h = self._run(given, t, targets, windows, sources, None, rows)
        unet = self.unet
        if unet.conv_norm_out is not None:
            h = unet.conv_act(unet.conv_norm_out(h))
        predicted, change = (head(h).unflatten(0, noisy.shape[:2]) for head in (unet.conv_out, self.regression))
        if self.signal is not None:
            predicted = lacking.linear - lacking.scale * predicted.float()
        return torch.where(at_once, noisy.to(change.dtype) + change, predicted)

    def _lacking(self, noisy: torch.Tensor, t: torch.Tensor, targets: Views) -> Lacking:
        """How a network sees, and predicts, what the condition lacks.

        With x_t = a x0 + s ε and x0 = c + r, r of variance σ² given nothing else, z = (x_t − a c) / √D of
        D = a² σ² + s² has unit variance, and the best linear guess is x0 = c + a σ² / √D z. The network gets z and adds
        σ s / √D times its output n (the preconditioning of Karras et al. 2022, around c instead of 0). Then
        v = (a x_t − x0) / s = −s c + a s (1 − σ²) / √D z − σ / √D n, which is finite for all t.
        """
        a, s, deviation, root = self._deviations(t, targets)
        condition = targets.latent.float()
        z = (noisy.float() - a * condition) / root
        return Lacking(z, -s * condition + a * s * (1 - deviation**2) / root * z, deviation / root)

    def unit(self, t: torch.Tensor, targets: Views) -> torch.Tensor:
        """What the network's output counts in what ``forward`` gives at t (B, N), (B, N, 1, h, w): errors in this unit
        are of one size at all t, in holes and outside. 1 where the network predicts v or ε itself."""
        if self.signal is None:
            return torch.ones_like(targets.mask, dtype=torch.float32)
        _, _, deviation, root = self._deviations(t, targets)
        return torch.where((t == REGRESSION)[:, :, None, None, None], deviation, deviation / root)

    def _deviations(
        self, t: torch.Tensor, targets: Views
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """a, s, σ and √D of ``_lacking``."""
        assert self.signal is not None
        a = self.signal.to(t.device)[t.clamp(max=TIMESTEPS - 1)][:, :, None, None, None]
        s = (1 - a**2).sqrt()
        inside, outside = self.deviation.float()
        deviation = inside + (outside - inside) * targets.mask.float()
        return a, s, deviation, ((a * deviation) ** 2 + s**2).sqrt()

    def _run(
        self,
        noisy: torch.Tensor,
        t: torch.Tensor,
        views: Views,
        windows: Sequence[TokenWindow],
        sources: Sources | None,
        read: Sources | None,
        rows: list[Rows] | None,
    ) -> torch.Tensor:
        """All blocks of the U-Net. Sources, which have none themselves, leave in ``read`` what targets read of them."""
        unet, count = self.unet, noisy.shape[:2]
        x = views.channels(noisy).flatten(0, 1).to(self.dtype)
        emb = unet.time_embedding(unet.time_proj(t.flatten()).to(self.dtype))
        context = self.context(views.pose.flatten(0, 1))
        place, done = 0, 0  # blocks of the U-Net, and cross-view blocks among them

        def attend(h: torch.Tensor, window: TokenWindow) -> torch.Tensor:
            nonlocal place, done
            name, place = str(place), place + 1
            if name not in self.cross_view:
                return h
            known = None if sources is None else sources[done]
            block = self.cross_view[name]
            assert isinstance(block, CrossViewAttention)
            done += 1
            if read is not None and done == len(self.cross_view):  # nothing is decoded of a source
                read.append(block.keys_values(_tokens(h, count)))
                return h
            h, own, of_block = self._saved(_attended, block, h, window, known, count, rows is not None)
            if read is not None:
                read.append(own)
            if rows is not None and of_block is not None:
                rows.append(Rows(of_block, window.bilinear(), window.place // window.valid[0, 0, 0].numel()))
            return h

        h = unet.conv_in(x)
        skips = [h]
        for block, window in zip(unet.down_blocks, windows, strict=True):
            h, inner = self._saved(_encoded, block, h, emb, context)
            h = attend(h, window)
            skips += [*inner[:-1], h]  # what the decoder gets of a block has read the other views
            if block.downsamplers is not None:
                h = block.downsamplers[0](h)
                skips.append(h)
        h = self._saved(unet.mid_block, h, emb, context)
        h = attend(h, windows[-1])
        for block, window in zip(unet.up_blocks, reversed(windows), strict=True):
            taken = skips[-len(block.resnets) :]
            del skips[-len(block.resnets) :]
            h = self._saved(_decoded, block, h, taken, emb, context)
            h = attend(h, window)
            if read is not None and done == len(self.cross_view):
                break
            if block.upsamplers is not None:
                h = block.upsamplers[0](h, skips[-1].shape[-2:])  # odd sizes need to be told
        return h

    def _saved(self, function: Callable[..., Any], *arguments: Any) -> Any:
        if self.gradient_checkpointing and torch.is_grad_enabled():
            return checkpoint(function, *arguments, use_reentrant=False)
        return function(*arguments)


# --- the U-Net's blocks, up to their resamplers -----------------------------------------------------------------------
def _encoded(
    block: Any, h: torch.Tensor, emb: torch.Tensor, context: torch.Tensor
) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """An encoder block's output and its skips, the last of which is the output."""
    skips = []
    for k, resnet in enumerate(block.resnets):
        h = resnet(h, emb)
        if getattr(block, "has_cross_attention", False):
            h = block.attentions[k](h, encoder_hidden_states=context, return_dict=False)[0]
        skips.append(h)
    return h, skips


def _decoded(
    block: Any, h: torch.Tensor, skips: Sequence[torch.Tensor], emb: torch.Tensor, context: torch.Tensor
) -> torch.Tensor:
    for k, (resnet, skip) in enumerate(zip(block.resnets, reversed(skips), strict=True)):
        h = resnet(torch.cat([h, skip], 1), emb)
        if getattr(block, "has_cross_attention", False):
            h = block.attentions[k](h, encoder_hidden_states=context, return_dict=False)[0]
    return h


def _attended(
    block: CrossViewAttention,
    h: torch.Tensor,
    window: TokenWindow,
    known: KeysValues | None,
    count: Sequence[int],
    with_rows: bool,
) -> tuple[torch.Tensor, KeysValues, torch.Tensor | None]:
    """Features (B Q, width, h, w) after reading [sources, these]; these views' own keys and values; L_geo's rows."""
    tokens = _tokens(h, count)
    keys, values = own = block.keys_values(tokens)
    if known is not None:
        keys, values = (torch.cat(both, 1) for both in zip(known, own, strict=True))
    tokens, rows = block(tokens, keys, values, window, with_rows=with_rows)
    return tokens.flatten(0, 1).transpose(1, 2).reshape(h.shape), own, rows


def _tokens(h: torch.Tensor, count: Sequence[int]) -> torch.Tensor:
    """(B, Q, T, width) of features (B Q, width, h, w)."""
    return h.flatten(2).transpose(1, 2).unflatten(0, tuple(count))


# --- loading ----------------------------------------------------------------------------------------------------------
def check_unet(unet: Any) -> None:
    """Refuse U-Nets that the loop over their blocks does not know.

    Raises:
        GeneratorError: Which block or embedding is not supported.
    """
    config = unet.config
    kinds = [*config.down_block_types, config.mid_block_type, *config.up_block_types]
    strange = sorted({str(kind) for kind in kinds} - set(_BLOCKS))
    if strange:
        raise GeneratorError(f"U-Net: expected blocks of {', '.join(_BLOCKS)}, got {', '.join(strange)}")
    for name in _UNUSED:
        if getattr(config, name):
            raise GeneratorError(
                f"U-Net: expected no {name}, as in Stable Diffusion 1.5, got {getattr(config, name)!r}"
            )
    if not isinstance(config.cross_attention_dim, int):
        raise GeneratorError(f"U-Net: expected one cross-attention width, got {config.cross_attention_dim!r}")


def widen(unet: Any, channels: int) -> None:
    """Give ``conv_in`` more input channels, with zero weights: what the U-Net computes stays."""
    old = unet.conv_in
    more = channels - old.in_channels
    if more == 0:
        return
    if old.in_channels != unet.config.out_channels:
        expected = f"{unet.config.out_channels} input channels, as many as output channels, or all {channels}"
        raise GeneratorError(f"U-Net: expected {expected}, got {old.in_channels}")
    new = nn.Conv2d(channels, old.out_channels, old.kernel_size, old.stride, old.padding, device="meta")
    extra = old.weight.new_zeros(old.out_channels, more, *old.kernel_size)
    new.weight = nn.Parameter(torch.cat([old.weight.detach(), extra], 1))
    new.bias = nn.Parameter(old.bias.detach())
    unet.conv_in = new
    unet.register_to_config(in_channels=channels)
