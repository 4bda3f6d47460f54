"""Accessibility of a page in a browser, judged by axe-core."""

from functools import cache

from tests.node_packages import install
from tests.web.phone import Phone

_RUN = """(async () => {
  const { violations } = await axe.run(document, { resultTypes: ["violations"] });
  return violations.filter(one => ["serious", "critical"].includes(one.impact)).flatMap(one =>
    one.nodes.map(node => `${one.id}: ${node.target.join(" ")}: ${one.help}`));
})()"""


@cache
def _source() -> str:
    home = install("node_axe", "axe-core@4.14.1")
    return (home / "node_modules" / "axe-core" / "axe.min.js").read_text(encoding="utf-8")


def serious_faults(browser: Phone) -> list[str]:
    """Return the serious and critical faults of a page; skip the test if axe-core cannot be installed."""
    if not browser.run("'axe' in window"):
        browser.run(f"{_source()}; undefined")
    return [str(fault) for fault in browser.run(_RUN)]
