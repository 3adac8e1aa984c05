"""The networks: the multi-branch denoising U-Net and the autoencoder (Sec. Network Architecture; appendix).

Every view is a branch of one set of weights. Source branches (existing images: clean, t = 0) read each other; target
branches (noisy, t) read sources and targets. The sources' keys and values do not depend on the step, so they are
computed once (``read_sources``) and reused in all steps.

A ``CrossViewAttention`` follows each of the U-Net's encoder blocks, its middle block and its decoder blocks, before
their resamplers: for Stable Diffusion widths (320, 640, 1280, 1280), 1280, (1280, 1280, 640, 320). The U-Net is loaded
first and composed with them afterwards: their outputs start at zero, so the U-Net's output is unchanged.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import nn
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from arbiview_aug.environment import optional_package
from arbiview_aug.generator.attention import LEVELS, CrossViewAttention, TokenWindow
from arbiview_aug.generator.conditioning import PoseContext, ViewInputs, input_channels
from arbiview_aug.generator.config import TIMESTEPS, GeneratorConfig

REGRESSION = TIMESTEPS  # predicts x0 in one step, from the pre-filled latent instead of a noisy one

KeysValues = tuple[torch.Tensor, torch.Tensor]
Sources = list[KeysValues]  # (B, S, T, width) of S source branches, for each cross-view block in the order they run


class Rows(NamedTuple):
    """Attention maps of one block for L_geo, over the 3 x 3 taps of the E valid (token, pair, level)."""

    predicted: torch.Tensor  # (E, 9) M_ij^pred
    target: torch.Tensor  # (E, 9) M_ij^target, bilinear weights at H p_i
    pair: torch.Tensor  # (E,) int64 index of the pair (i, j) of a row


class Denoiser(nn.Module):
    """ε_θ(x_t, t, f_pose) of L_main for N target views at once, and x0 in one step at t = ``REGRESSION``.

    Args:
        unet: A diffusers ``UNet2DConditionModel`` as ``UNetConfig`` describes; ``conv_in`` is widened by zeros.
        config: With ``residual`` the network predicts the residual between image and condition.
    """

    signal: torch.Tensor | None = None  # (T,) √ᾱ_t of the schedule, if ``residual``; no buffer: halves would round it
    deviation: torch.Tensor  # (2,) of the residual inside holes and outside; measured before training

    def __init__(self, unet: Any, config: GeneratorConfig) -> None:
        super().__init__()
        latent_channels = int(unet.config.out_channels)
        widen(unet, input_channels(latent_channels))
        self.unet = unet
        widths = tuple(unet.config.block_out_channels)
        used = config.unet.cross_view or (True,) * len(widths)
        blocks = zip((*widths, widths[-1], *widths[::-1]), (*used, used[-1], *used[::-1]), strict=True)
        self.cross_view = nn.ModuleDict(
            {str(k): CrossViewAttention(width, len(LEVELS)) for k, (width, is_used) in enumerate(blocks) if is_used}
        )
        self.context = PoseContext(int(unet.config.cross_attention_dim), config.prompt_tokens)
        self.regression = nn.Conv2d(widths[0], latent_channels, 3, padding=1)
        nn.init.zeros_(self.regression.weight)
        nn.init.zeros_(self.regression.bias)  # type: ignore[arg-type]
        self.gradient_checkpointing = False
        if config.residual:
            with torch.device("cpu"):  # also where the weights are on meta
                self.signal = noise_schedule(config).alphas_cumprod.double().sqrt().float()
            self.register_buffer("deviation", torch.tensor([0.3, 0.1]))
            nn.init.zeros_(unet.conv_out.weight)
            nn.init.zeros_(unet.conv_out.bias)

    def own_parameters(self) -> list[nn.Parameter]:
        """Parameters trained next to a frozen U-Net: attention, pose, one-step head, widened ``conv_in``."""
        parts = (self.cross_view, self.context, self.regression, self.unet.conv_in)
        return [parameter for part in parts for parameter in part.parameters()]

    def read_sources(self, sources: ViewInputs, windows: Sequence[TokenWindow]) -> Sources:
        """Run the source branches, which read sources only; ``windows``: one for each token grid, the finest first."""
        t = torch.zeros(len(sources.latent), dtype=torch.long, device=sources.latent.device)
        clean = sources.latent if self.signal is None else torch.zeros_like(sources.latent)  # their residual is 0
        return self._run(clean, t, sources, windows)[1]

    def forward(
        self,
        noisy: torch.Tensor,
        t: torch.Tensor,
        targets: ViewInputs,
        windows: Sequence[TokenWindow],
        sources: Sources,
        rows: list[Rows] | None = None,
    ) -> torch.Tensor:
        """Predict N target views of B frames.

        Args:
            noisy: (B, N, C, h, w) x_t; the pre-filled latent at t = ``REGRESSION``.
            t: (B,) int64 in [0, ``REGRESSION``].
            targets: Their conditions.
            windows: Windows of the targets in [sources, targets], one for each token grid, the finest first.
            sources: From ``read_sources``.
            rows: A list to append L_geo's rows to, one entry per block.

        Returns:
            (B, N, C, h, w): the schedule's prediction (ε or v), or x0 at t = ``REGRESSION``.
        """
        is_regression = (t == REGRESSION).view(-1, 1, 1, 1, 1)
        x = noisy
        if self.signal is not None:
            a, s, deviation, root = self._deviations(t, targets)
            condition = targets.latent.float()
            z = (noisy.float() - a * condition) / root
            x = z.masked_fill(is_regression, 0)
        h, _ = self._run(x, t, targets, windows, sources, rows)
        unet = self.unet
        if unet.conv_norm_out is not None:
            h = unet.conv_act(unet.conv_norm_out(h))
        predicted, change = (head(h).unflatten(0, noisy.shape[:2]) for head in (unet.conv_out, self.regression))
        if self.signal is not None:
            linear = -s * condition + a * s * (1 - deviation**2) / root * z
            predicted = linear - deviation / root * predicted.float()
        return torch.where(is_regression, noisy.to(change.dtype) + change, predicted)

    def output_scale(self, t: torch.Tensor, targets: ViewInputs) -> torch.Tensor:
        """(B, N, 1, h, w) factor of the network's output in ``forward``'s at t (B,).

        Errors divided by it have one size at all t, in holes and outside. 1 without preconditioning.
        """
        if self.signal is None:
            return torch.ones_like(targets.mask, dtype=torch.float32)
        _, _, deviation, root = self._deviations(t, targets)
        return torch.where((t == REGRESSION).view(-1, 1, 1, 1, 1), deviation, deviation / root)

    def _deviations(self, t: torch.Tensor, targets: ViewInputs) -> tuple[torch.Tensor, ...]:
        """a, s, σ and √D for preconditioning around the condition c (Karras et al. 2022, there around 0).

        With x_t = a x0 + s ε and x0 = c + r, r of variance σ², z = (x_t − a c) / √D with D = a² σ² + s² has unit
        variance, and the best linear estimate is x0 = c + a σ² / √D z. The network sees z, and σ s / √D times its
        output n is added. Then v = (a x_t − x0) / s = −s c + a s (1 − σ²) / √D z − σ / √D n, finite for all t.
        """
        assert self.signal is not None
        a = self.signal.to(t.device)[t.clamp(max=TIMESTEPS - 1)].view(-1, 1, 1, 1, 1)
        s = (1 - a**2).sqrt()
        inside, outside = self.deviation.float()
        deviation = inside + (outside - inside) * targets.mask.float()
        return a, s, deviation, ((a * deviation) ** 2 + s**2).sqrt()

    def _run(
        self,
        noisy: torch.Tensor,
        t: torch.Tensor,
        views: ViewInputs,
        windows: Sequence[TokenWindow],
        sources: Sources | None = None,
        rows: list[Rows] | None = None,
    ) -> tuple[torch.Tensor, Sources]:
        """Run all blocks of the U-Net; also returns the views' keys and values. Sources end at their last ones."""
        unet, count = self.unet, noisy.shape[:2]
        x = views.channels(noisy).flatten(0, 1).to(unet.dtype)
        emb = unet.time_embedding(unet.time_proj(t.repeat_interleave(count[1])).to(unet.dtype))
        context = self.context(views.pose.flatten(0, 1))
        blocks = itertools.count()
        keys_values: Sources = []

        def attend(h: torch.Tensor, window: TokenWindow) -> torch.Tensor:
            name = str(next(blocks))
            if name not in self.cross_view:
                return h
            block: Any = self.cross_view[name]
            if sources is None and len(keys_values) == len(self.cross_view) - 1:  # nothing is decoded of a source
                keys_values.append(block.keys_values(_tokens(h, count)))
                return h
            others = None if sources is None else sources[len(keys_values)]
            h, tokens, predicted = self._checkpointed(_read_views, block, h, window, others, count, rows is not None)
            keys_values.append(tokens)
            if rows is not None:
                rows.append(Rows(predicted, window.bilinear(), window.place // window.valid[0, 0, 0].numel()))
            return h

        h = unet.conv_in(x)
        skips = [h]
        for block, window in zip(unet.down_blocks, windows, strict=True):
            *inner, h = self._checkpointed(_layers, block, h, emb, context)
            h = attend(h, window)
            skips += [*inner, h]  # the last skip has read the other views
            if block.downsamplers is not None:
                h = block.downsamplers[0](h)
                skips.append(h)
        h = self._checkpointed(unet.mid_block, h, emb, context)
        h = attend(h, windows[-1])
        for block, window in zip(unet.up_blocks, reversed(windows), strict=True):
            skips, inner = skips[: -len(block.resnets)], skips[-len(block.resnets) :]
            h = self._checkpointed(_layers, block, h, emb, context, inner)[-1]
            h = attend(h, window)
            if sources is None and len(keys_values) == len(self.cross_view):
                break
            if block.upsamplers is not None:
                h = block.upsamplers[0](h, skips[-1].shape[-2:])  # odd sizes need to be told
        return h, keys_values

    def _checkpointed(self, function: Callable[..., Any], *arguments: Any) -> Any:
        if self.gradient_checkpointing and torch.is_grad_enabled():
            return checkpoint(function, *arguments, use_reentrant=False)
        return function(*arguments)


def _layers(
    block: Any, h: torch.Tensor, emb: torch.Tensor, context: torch.Tensor, skips: Sequence[torch.Tensor] = ()
) -> list[torch.Tensor]:
    """Outputs of the layers of a U-Net's block, up to its resampler; a decoder's layers read skips, the last first."""
    outputs = []
    for k, resnet in enumerate(block.resnets):
        h = resnet(torch.cat([h, skips[-1 - k]], 1) if skips else h, emb)
        if getattr(block, "has_cross_attention", False):
            h = block.attentions[k](h, encoder_hidden_states=context, return_dict=False)[0]
        outputs.append(h)
    return outputs


def _read_views(
    block: CrossViewAttention,
    h: torch.Tensor,
    window: TokenWindow,
    others: KeysValues | None,
    count: Sequence[int],
    with_rows: bool,
) -> tuple[torch.Tensor, KeysValues, torch.Tensor | None]:
    """Features (B Q, width, h, w) after reading [others, these views]; these views' keys and values; L_geo's rows."""
    tokens = _tokens(h, count)
    keys, values = view_tokens = block.keys_values(tokens)
    if others is not None:
        keys, values = (torch.cat(both, 1) for both in zip(others, view_tokens, strict=True))
    tokens, rows = block(tokens, keys, values, window, with_rows)
    return tokens.flatten(0, 1).transpose(1, 2).reshape(h.shape), view_tokens, rows


def _tokens(h: torch.Tensor, count: Sequence[int]) -> torch.Tensor:
    """(B, Q, T, width) of features (B Q, width, h, w)."""
    return h.flatten(2).transpose(1, 2).unflatten(0, tuple(count))


def widen(unet: Any, channels: int) -> None:
    """Give ``conv_in`` more input channels with zero weights: the U-Net's output is unchanged."""
    old = unet.conv_in
    if channels == old.in_channels:
        return
    new = nn.Conv2d(channels, old.out_channels, old.kernel_size, old.stride, old.padding, device="meta")
    extra = old.weight.new_zeros(old.out_channels, channels - old.in_channels, *old.kernel_size)
    new.weight = nn.Parameter(torch.cat([old.weight.detach(), extra], 1))
    new.bias = nn.Parameter(old.bias.detach())
    unet.conv_in = new
    unet.register_to_config(in_channels=channels)


def noise_schedule(config: GeneratorConfig) -> Any:
    """Stable Diffusion's schedule (scaled linear, β from 0.00085 to 0.012, 1000 steps).

    ``zero_snr`` rescales it to zero terminal SNR (Lin et al. 2023).
    """
    return optional_package("diffusers", "generator").DPMSolverMultistepScheduler(
        num_train_timesteps=TIMESTEPS,
        beta_start=0.00085,
        beta_end=0.012,
        beta_schedule="scaled_linear",
        prediction_type=config.prediction,
        rescale_betas_zero_snr=config.zero_snr,
        timestep_spacing="trailing",
    )


class Autoencoder(nn.Module):
    """diffusers' ``AutoencoderKL`` with images in [0, 1] and latents of unit variance, or squares of pixels.

    ``vae`` is None for pixels in [-1, 1], with ``patch`` pixels along a latent pixel's side.
    """

    def __init__(self, vae: Any | None, scale: float = 1.0, patch: int = 1) -> None:
        super().__init__()
        self.vae, self.patch = vae, patch
        self.scale = float(scale)  # of the latents; no buffer, since half precision would round it

    def encode(self, images: torch.Tensor) -> torch.Tensor:
        """Encode images (B, N, 3, H, W) in [0, 1] to latents (B, N, C, H / f, W / f), without sampling."""
        images = images * 2 - 1
        if self.vae is None:
            return functional.pixel_unshuffle(images, self.patch)
        latents = self.vae.encode(images.flatten(0, 1).to(self.vae.dtype)).latent_dist.mode() * self.scale
        return latents.unflatten(0, images.shape[:2])

    def decode(self, latents: torch.Tensor) -> torch.Tensor:
        """Decode latents (B, N, C, h, w) to images (B, N, 3, H, W), in [0, 1] up to over- and undershoot."""
        if self.vae is None:
            images = functional.pixel_shuffle(latents, self.patch)
        else:
            flat = latents.flatten(0, 1).to(self.vae.dtype) / self.scale
            images = self.vae.decode(flat).sample.unflatten(0, latents.shape[:2])
        return images / 2 + 0.5
