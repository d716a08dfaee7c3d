"""What a topic of a recording holds, for people: LiDAR, fields, times of points, frames, noise."""

from __future__ import annotations

from pipeline.io.readers.base import RecordedTopic


def topic_details(topic: RecordedTopic) -> list[tuple[str, str]]:
    """Return rows (word, text) about a topic that is read, or could be read in a role; rows without anything
    to tell are left out."""
    role = topic.read_as or topic.fits
    chain = " > ".join(topic.chain)
    if topic.frame and not topic.chain and role in ("scan", "imu", "gnss", "odometry", "pose"):
        chain = f"{topic.frame}, which no fixed transform links to the base"
    if role in ("odometry", "pose") and topic.frame:
        robot = chain if topic.chain else "a frame that no fixed transform links to the base"
        chain = f"pose of {robot} in {topic.frame}"
    noise = "" if topic.range_sigma is None else f"{100.0 * topic.range_sigma:.1f} cm of a range (one sigma)"
    rows = [
        ("LiDAR", topic.family),
        ("fields", ", ".join(topic.fields)),
        ("times", topic.times),
        ("frame", chain),
        ("noise", noise),
    ]
    return [(word, text) for word, text in rows if text]
