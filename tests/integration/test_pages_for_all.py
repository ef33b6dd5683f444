"""The pages for everybody: on a narrow screen, by keys alone, with little sight, on paper."""

import pytest
from small_results import waves, write_result

from dsr.cli import main
from dsr.evaluation.run_files import load_results
from dsr.report.page import Pictures, save_page
from dsr.report.study import Choice
from dsr.report.study.questionnaire import build_study
from dsr.report.worker_pool import WorkerPool

PAGES = ("report", "leaderboard", "view", "study", "trial")
NARROW, WIDE = {"width": 360, "height": 740}, {"width": 1280, "height": 900}
LONG = "A method with a rather long name"
CUT = """() => [...document.querySelectorAll('button, label, h1, h2, h3, dt, dd, .caption, .label, nav a, figcaption')]
  .filter((e) => e.offsetWidth && getComputedStyle(e).display !== 'inline' && e.scrollWidth > e.clientWidth + 1)
  .map((e) => e.textContent)"""
FOCUS = """() => {
  const e = document.activeElement;
  const style = getComputedStyle((e.matches('.divider') && e.firstElementChild) || e);
  const box = e.getBoundingClientRect();
  const shown = style.outlineStyle !== 'none' && parseFloat(style.outlineWidth) >= 2;
  const inside = box.bottom > 0 && box.top < innerHeight && box.right > 0 && box.left < innerWidth;
  return e === document.body ? null : [e.outerHTML.slice(0, 90), shown && inside && box.width > 0];
}"""
CONTRASTS = """() => {
  const level = (c) => (c /= 255) <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4;
  const light = ([r, g, b]) => 0.2126 * level(r) + 0.7152 * level(g) + 0.0722 * level(b);
  const numbers = (text) => (text.match(/[\\d.]+/g) || []).map(Number);
  const over = (top, below) => {
    const alpha = top[3] ?? 1;
    return top.slice(0, 3).map((value, k) => alpha * value + (1 - alpha) * below[k]);
  };
  const ground = (e) => {
    if (!e) return matchMedia('(prefers-color-scheme: dark)').matches ? [0, 0, 0] : [255, 255, 255];
    const own = numbers(getComputedStyle(e).backgroundColor);
    if ((own[3] ?? 1) === 1) return own;
    return over(own, e.classList.contains('stage') ? [60, 66, 74] : ground(e.parentElement));
  };
  const low = [];
  for (const e of document.querySelectorAll('body *')) {
    const text = [...e.childNodes].some((node) => node.nodeType === 3 && node.data.trim());
    if (!text || !e.checkVisibility({ visibilityProperty: true }) || e.closest(':disabled, .busy, .silent')) continue;
    const below = ground(e), style = getComputedStyle(e);
    const a = light(over(numbers(style.color), below)), b = light(below);
    const large = parseFloat(style.fontSize) >= 24 || (parseFloat(style.fontSize) >= 18.66 && style.fontWeight >= 700);
    const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    if (ratio < (large ? 3 : 4.5)) low.push([ratio.toFixed(2), e.tagName, e.className, e.textContent.slice(0, 40)]);
  }
  return low;
}"""


@pytest.fixture(scope="module")
def addresses(make_run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("pages")
    for label in ("Bicubic", "MSG-V", LONG):
        name = label.lower().replace(" ", "_")
        make_run(
            folder / "runs" / name, method=name, label=label, scenes=("a", "b"), size=64, confident=label == "MSG-V"
        )
    runs = load_results([folder / "runs"])
    save_page(folder / "report.html", Pictures(WorkerPool(runs)), title="A report")
    assert main(["leaderboard", str(folder / "runs"), "-o", str(folder / "leaderboard")]) == 0
    build_study(runs, folder / "study", Choice(repeat=1))
    write_result(folder / "view" / "a room with a name of its own")
    write_result(folder / "view" / "b", waves(hole=False), with_input=False, with_errors=False)
    assert main(["view", str(folder / "view"), "--no-open"]) == 0
    study = folder / "study" / "index.html"
    files = (folder / "report.html", folder / "leaderboard" / "index.html", folder / "view" / "view.html", study, study)
    return dict(zip(PAGES, (path.as_uri() for path in files), strict=True))


@pytest.fixture
def visit(window, addresses):
    def open_page(name, **options):
        page = window(reduced_motion="reduce", **options).page
        page.goto(addresses[name])
        if name in ("report", "leaderboard", "view"):
            page.wait_for_selector(".stage[data-shown]")
        if name == "trial":
            page.locator("#begin").click()
            page.wait_for_selector(".tile")
        return page

    return open_page


@pytest.mark.parametrize("name", PAGES)
def test_page_is_as_wide_as_the_window_labels_are_whole_and_text_stands_out(visit, name):
    for size, scheme in ((NARROW, "light"), (WIDE, "dark")):
        page = visit(name, viewport=size, color_scheme=scheme)
        assert page.evaluate("document.documentElement.scrollWidth") <= size["width"]
        assert page.evaluate(CUT) == []
        assert page.evaluate(CONTRASTS) == []


@pytest.mark.parametrize("name", PAGES)
def test_keys_reach_everything_and_show_where_they_are(visit, name):
    page, seen = visit(name), []
    for _ in range(80):
        page.keyboard.press("Tab")
        found = page.evaluate(FOCUS)
        if found is None or [found[0], True] in seen[:1]:
            break
        seen.append(found)
    assert len(seen) >= {"study": 2, "trial": 5}.get(name, 12)
    assert [what for what, shown in seen if not shown] == []
