"""Viewers: a live scene in the browser, and self-contained HTML pages."""

from .html_page import HtmlPage as HtmlPage
from .html_page import view_html as view_html
from .viewer import Viewer as Viewer
from .viewer import view as view
