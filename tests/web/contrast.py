"""The contrast of WCAG 2.2, of all visible parts of a page."""

from tests.web.phone import Phone

# Text needs 4.5 to 1, large text and the edges of fields 3 to 1 (success criteria 1.4.3 and 1.4.11).
# Disabled controls are exempt.
_SCRIPT = """(() => {
  const rgba = text => {
    const [r, g, b, a = 1] = text.match(/[\\d.]+/g).map(Number);
    return [r, g, b, a];
  };
  const over = (top, below) => [0, 1, 2].map(n => top[n] * top[3] + below[n] * (1 - top[3])).concat(1);
  const behind = element => {
    const layers = [];
    for (let e = element; e; e = e.parentElement) layers.push(rgba(getComputedStyle(e).backgroundColor));
    return layers.reverse().reduce((below, top) => over(top, below), [255, 255, 255, 1]);
  };
  const luminance = colour => {
    const part = value => (value /= 255) <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4;
    return 0.2126 * part(colour[0]) + 0.7152 * part(colour[1]) + 0.0722 * part(colour[2]);
  };
  const ratio = (a, b) => {
    const [low, high] = [luminance(a), luminance(b)].sort((x, y) => x - y);
    return (high + 0.05) / (low + 0.05);
  };
  const isSeen = e => e.getClientRects().length && getComputedStyle(e).visibility === "visible"
    && !e.closest(":disabled, script, style");
  const low = [];
  let count = 0;
  const judge = (what, element, ink, ground, least) => {
    count += 1;
    const reached = ratio(over(ink, ground), ground);
    if (reached < least) low.push(`${what}: ${reached.toFixed(2)} < ${least}`);
  };
  const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  const elements = [...document.querySelectorAll("input, select")].map(e => [e, e.value]);
  while (texts.nextNode()) elements.push([texts.currentNode.parentElement, texts.currentNode.data]);
  for (const [element, text] of elements) {
    if (!text.trim() || !isSeen(element)) continue;
    const style = getComputedStyle(element), size = parseFloat(style.fontSize);
    const large = size >= 24 || (size >= 18.66 && Number(style.fontWeight) >= 700);
    const ink = rgba(element instanceof SVGElement ? style.fill : style.color);
    judge(text.trim().slice(0, 40), element, ink, behind(element), large ? 3 : 4.5);
  }
  for (const field of document.querySelectorAll(".cm, select, fieldset span")) {
    if (!isSeen(field)) continue;
    judge(`edge of ${field.className || field.tagName}`, field, rgba(getComputedStyle(field).borderTopColor),
      behind(field.parentElement), 3);
  }
  return [low, count];
})()"""


def low_contrasts(browser: Phone) -> list[str]:
    """Return the texts and edges of a page that are hard to see."""
    low, count = browser.run(_SCRIPT)
    assert count > 5
    return [str(text) for text in low]
