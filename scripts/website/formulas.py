"""LaTeX between $ and $$ as drawings: SVG with the glyphs as paths, so that pages need no script, no font and no network."""

from __future__ import annotations

import html
import re
from functools import cache

import ziamath
from latex2mathml.converter import convert

EM = 24.0  # units of a drawing that are one em of the text around it
INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.DOTALL)
DISPLAY = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.DOTALL)


def draw_formulas(page: str) -> str:
    """The HTML of a page with its formulas drawn. Raises ValueError, naming the formula, for LaTeX that is not understood."""
    page = DISPLAY.sub(lambda found: f'<div class="formula">{formula(html.unescape(found[1]), False)}</div>', page)
    return INLINE.sub(lambda found: formula(html.unescape(found[1]), True), page)


@cache
def formula(tex: str, inline: bool) -> str:
    """One formula as an <svg> that scales with the text, stands on its baseline and takes its colour."""
    tex = " ".join(tex.split())
    try:
        if "\\" in re.sub(r"<annotation.*?</annotation>", "", convert(tex)):
            raise ValueError("a command is not known")
        ziamath.config.svg2 = False  # paths in place, no names that could meet
        drawn = ziamath.Latex(tex, size=EM, color="currentColor", inline=inline)
        text = drawn.svg()
    except Exception as error:
        raise ValueError(f"formula {tex}: {error}") from error
    box = re.search(r'viewBox="([^"]*)"', text)
    assert box is not None
    left, top, width, height = (float(x) for x in re.split(r"[ ,]+", box[1].strip()))
    style = f"width:{width / EM:.3f}em;height:{height / EM:.3f}em;vertical-align:{-(top + height) / EM:.3f}em"
    inner = text[text.index(">", text.index("<svg")) + 1 :]
    label = html.escape(tex, quote=True)
    return f'<svg class="math" role="img" aria-label="{label}" style="{style}" viewBox="{left} {top} {width} {height}">{inner}'
