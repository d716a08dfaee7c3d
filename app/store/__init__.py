"""What people say of the trees, kept on disk: runs, annotations and every edit of them.

Nothing that was acknowledged is lost, also after a power cut or `kill -9`. All calls block: the server
makes them in a thread of their own (`app.dashboard.annotations`).
"""
