"""A live viewer in the browser, and recordings that it replays; `pip install 'isdf-planning[viewer]'`.

viewer = Viewer(port=8080)              # http://localhost:8080
viewer.show(lambda: ViewState(time, field=mapper.field()))      # returns at once; only the newest is drawn
viewer.controls.may_go()                # False while somebody has pressed Pause
"""

from .controls import Controls
from .mailbox import Mailbox
from .recording import Recorder, Recording
from .state import Line, Shape, Spheres, ViewState
from .viewer import Viewer

__all__ = [
    "Controls",
    "Line",
    "Mailbox",
    "Recorder",
    "Recording",
    "Shape",
    "Spheres",
    "ViewState",
    "Viewer",
]
