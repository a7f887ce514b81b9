"""Viewers: a scene in the browser with sliders, and pages that play anywhere."""

from .page import HtmlPage as HtmlPage
from .page import view_html as view_html
from .viewer import Viewer as Viewer
from .viewer import view as view
