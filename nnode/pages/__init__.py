"""Pages of results: text, tables and figures as HTML, Markdown and CSV."""
