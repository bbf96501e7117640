"""Records equations over ``Operations`` once, and generates values, slopes and batches from the recording.

Read ``tape`` first (the recording), then ``rows`` (equations of many items, sorted by what they depend on), ``slopes``
(the rules of differentiation), ``scalar_rows`` and ``batch_rows`` (the code for one robot and for many).
"""

from safedpa.equations.rows import Given
from safedpa.equations.tape import NotRecordableError

__all__ = ["Given", "NotRecordableError"]
