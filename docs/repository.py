"""Links that need the repository's address: ``python docs/repository.py`` writes README's badges once it is known.

Nothing else names the address. While it is empty README has no badges, and relative links to images.
"""

import re
from pathlib import Path

REPOSITORY = ""
"""Such as ``"https://github.com/OWNER/NAME"``; empty until the project has a public address."""
README = Path(__file__).parents[1] / "README.md"
BADGES = re.compile(r"(?<=<!-- badges -->\n).*?(?=<!-- end of badges -->)", re.DOTALL)


def badges(repository: str) -> str:
    """Badges of tests and of the notebook in Colab, or nothing without an address."""
    if not repository:
        return ""
    notebook = repository.replace("https://", "https://colab.research.google.com/").replace("github.com/", "github/")
    return (
        f"[![tests]({repository}/actions/workflows/ci.yml/badge.svg)]({repository}/actions)\n"
        "[![open in Colab](https://colab.research.google.com/assets/colab-badge.svg)]"
        f"({notebook}/blob/main/docs/tutorial/notebook.ipynb)\n"
    )


def with_badges(text: str, repository: str) -> str:
    """The front page with the badges of this address between its two marks."""
    return BADGES.sub(lambda _: badges(repository), text)


def with_absolute_links(text: str, repository: str) -> str:
    """The front page as a package index needs it: images and pages by their full address."""
    if not repository:
        return text
    raw = repository.replace("https://github.com", "https://raw.githubusercontent.com")
    text = re.sub(r"(?<=!\[)([^\]]*\]\()(?!https?:)", rf"\1{raw}/main/", text)
    return re.sub(r"(?<!!)(\[[^\]!]*\]\()(?!https?:|#)", rf"\1{repository}/blob/main/", text)


if __name__ == "__main__":
    README.write_text(with_badges(README.read_text(), REPOSITORY))
