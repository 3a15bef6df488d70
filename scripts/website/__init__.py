"""What the documentation site is made of beyond the pages in docs/: hooks of mkdocs, and pages made from the source."""
