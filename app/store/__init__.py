"""What people say of the trees, kept on disk: runs, annotations and every edit of them.

Nothing that was acknowledged is lost, also after a power cut or `kill -9`. All calls block: the server
makes them in a thread of their own (`app.annotating`).
"""

from app.store.records import KINDS, Annotation, Author, Content
from app.store.store import MOST_ANNOTATIONS, StaleError, Store, UnknownError

__all__ = [
    "KINDS",
    "MOST_ANNOTATIONS",
    "Annotation",
    "Author",
    "Content",
    "StaleError",
    "Store",
    "UnknownError",
]
