"""FAVS, the published stages 1 to 4; imported where ``quality="paper"`` is asked for."""

from typing import TYPE_CHECKING

from arbiview_aug.environment import lazy_names

if TYPE_CHECKING:
    from arbiview_aug.favs.config import PaperConfig as PaperConfig
    from arbiview_aug.favs.renderer import PaperRendering as PaperRendering
    from arbiview_aug.favs.renderer import SourceReport as SourceReport
    from arbiview_aug.favs.renderer import as_rendered as as_rendered
    from arbiview_aug.favs.renderer import check_settings as check_settings
    from arbiview_aug.favs.renderer import render_paper as render_paper
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__)
