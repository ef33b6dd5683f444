"""Stylesheets of the pages: contrasts as WCAG 2.2 asks for (1.4.3, 1.4.11), for all pairs of colours, also on paper."""

import re

import pytest

from dsr.report.html_page import asset

SHEETS = ("report.css", "view.css", "study.css")
DARK = "@media (prefers-color-scheme: dark)"
GROUNDS = ("ground", "raised")
CONTROLS = ("edge", "accent")


def rules(text):
    """Yield the medium, selector and declarations of each rule; rules within rules do not occur but in media."""
    text = re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
    for medium, inner, selector, body in re.findall(
        r"(@media[^{]*)\{((?:[^{}]*\{[^{}]*\})*)[^{}]*\}|([^{}@]+)\{([^{}]*)\}", text
    ):
        found = re.findall(r"([^{}]+)\{([^{}]*)\}", inner) if medium else [(selector, body)]
        for each, declared in found:
            pairs = (line.partition(":") for line in declared.split(";") if ":" in line)
            yield medium.strip(), each.strip(), {name.strip(): value.strip() for name, _, value in pairs}


def tokens(sheet, *media):
    """Return the colours by name as they are for some media."""
    found = {}
    for medium, selector, declared in rules(asset(sheet)):
        if selector == ":root" and (not medium or medium in media):
            found |= {name[2:]: value for name, value in declared.items() if name.startswith("--")}
    return found


def rgb(value, known):
    while value.startswith("var("):
        value = known[value[6:-1]]
    digits = value.lstrip("#")
    digits = "".join(2 * each for each in digits) if len(digits) == 3 else digits
    return [int(digits[k : k + 2], 16) / 255 for k in (0, 2, 4)]


def luminance(colour):
    linear = [each / 12.92 if each <= 0.04045 else ((each + 0.055) / 1.055) ** 2.4 for each in colour]
    return sum(weight * each for weight, each in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


def contrast(first, second):
    lower, upper = sorted((luminance(first), luminance(second)))
    return (upper + 0.05) / (lower + 0.05)


def is_colour(value):
    return re.fullmatch(r"#[0-9a-f]{3,6}|var\(--[a-z-]+\)", value) is not None


def test_contrast_is_that_of_the_standard():
    assert contrast([0, 0, 0], [1, 1, 1]) == pytest.approx(21)
    assert contrast(rgb("#777", {}), rgb("#fff", {})) == pytest.approx(4.48, abs=0.005)


@pytest.mark.parametrize("media", [(), (DARK,), ("@media print",), (DARK, "@media print")], ids=str)
@pytest.mark.parametrize("sheet", SHEETS)
def test_every_text_and_every_control_stands_out(sheet, media):
    known, low = tokens(sheet, *media), []
    for medium, selector, declared in rules(asset(sheet)):
        text, own = declared.get("color", ""), declared.get("background", "")
        if (medium and medium not in media) or not is_colour(text) or (text == "#fff" and not is_colour(own)):
            continue  # white texts stand on pictures, or on dark ground of their own
        for ground in (own,) if is_colour(own) else (f"var(--{name})" for name in GROUNDS):
            if contrast(rgb(text, known), rgb(ground, known)) < 4.5:
                low.append((selector, text, ground))
    low += [
        (f"--{name}", ground)
        for name in CONTROLS for ground in GROUNDS
        if contrast(rgb(f"var(--{name})", known), rgb(f"var(--{ground})", known)) < 3
    ]  # fmt: skip
    assert low == []


@pytest.mark.parametrize("sheet", SHEETS)
def test_colours_of_a_page_are_named_for_light_and_dark(sheet):
    used = set(re.findall(r"var\(--([a-z-]+)[,)]", asset(sheet)))
    named = tokens(sheet).keys()
    dark = {name for medium, at, of in rules(asset(sheet)) if medium == DARK and at == ":root" for name in of}
    colours = {name for name in named if tokens(sheet)[name].startswith("#")}
    assert {f"--{name}" for name in used & colours} <= dark
