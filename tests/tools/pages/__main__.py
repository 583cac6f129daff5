"""Write the generated pages and parts, and delete stale pages: `python -m tests.tools.pages`."""

from tests.tools.pages.build import expected, stale_pages

if __name__ == "__main__":
    for path, text in expected().items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    for path in stale_pages():
        path.unlink()
