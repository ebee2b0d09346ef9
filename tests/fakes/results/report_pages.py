"""The requirements of every report: readable at 1200 pixels and without ``nan``."""

from __future__ import annotations

import re
from html import unescape

from imagine_bench.report.page import Page, texts

PAGE_PX = 1200 - 2 * 24  # the page's own margin
CHARACTER_PX, PADDING_PX = 8.0, 19.2


def check_page(page: str) -> None:
    """Assert it of the text of ``index.html``."""
    tables = read_tables(page)
    assert tables
    style = page[page.index("<style>") : page.index("</style>")]
    assert "nowrap" not in style  # so that a column can become as narrow as its longest word
    prose = re.findall(r"<table[^>]*prose", page)
    assert len(prose) < len(tables)
    for table in tables:
        if len(table[0]) > 2:
            assert narrowest_px(table) <= PAGE_PX, table[0]
    assert not re.search(r"\bnan\b", re.sub(r"<(style|svg)\b.*?</\1>|<[^>]+>", " ", page, flags=re.DOTALL))
    check_dashes(page)


def read_tables(page: str) -> list[list[list[str]]]:
    """The cells of all tables of a page: rows of texts, headers included."""
    tables = []
    for table in re.findall(r"<table.*?</table>", page, flags=re.DOTALL):
        rows = re.findall(r"<tr>.*?</tr>", table, flags=re.DOTALL)
        cells = [re.findall(r"<t[dh]>(.*?)</t[dh]>", row, flags=re.DOTALL) for row in rows]
        tables.append([[unescape(re.sub(r"<[^>]+>", " ", cell)) for cell in row] for row in cells])
    return tables


def narrowest_px(table: list[list[str]]) -> float:
    """Width of a table whose columns are as narrow as their longest words, in pixels."""
    longest = [
        max(len(word) for row in table for word in re.split(r"[\s-]", row[column])) for column in range(len(table[0]))
    ]
    return sum(CHARACTER_PX * length + PADDING_PX for length in longest)


def check_dashes(page: str) -> None:
    """A table with a dash explains the dash below it, or its section does."""
    for section in page.split("<h2>"):
        if re.search(r"<td[^>]*>–</td>", section):
            assert "–: " in section, section[:80]


def in_words(html: str) -> str:
    """A page as its reader sees it, a row of a table or a paragraph a line."""
    text = re.sub(r"<(style|svg|script|title)\b.*?</\1>", "", html, flags=re.DOTALL)
    text = re.sub(r"</t[dh]>\s*<t[dh][^>]*>", " | ", text)
    text = re.sub(r"</(tr|p|h\d|li|summary|caption|figcaption|table|dt|dd|pre)>", "\n", text)
    lines = [" ".join(unescape(re.sub(r"<[^>]+>", "", line)).split()) for line in text.splitlines()]
    return "\n".join(line for line in lines if line and "imagine_bench" not in line)


def page_in_words(page: Page) -> str:
    """A checked page, and of each of its files the first and last lines."""
    written = texts(page, images=False)
    index = written.pop("index.html")
    check_page(index)
    shown = [in_words(index)]
    for name, file in sorted(written.items()):
        rows = file.splitlines()
        shown += [f"== {name}: {len(rows)} lines", *rows[:3], *rows[-2:]]
    return "\n".join(shown)
