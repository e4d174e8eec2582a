"""A run as a page to look at: one HTML file with the model, its figures, and the command that makes it again."""

from gnrecon.report.html.notebook import result_html, show_page
from gnrecon.report.html.page import page_text, style_text, write_page

__all__ = ["page_text", "result_html", "show_page", "style_text", "write_page"]
