"""One bookkeeping device: a small memory at a vertex.

It holds a tag (bytes; what they mean belongs to the algorithm), counts how often the tag was
written (the revision), and has a capacity that no tag may exceed. A write that does not fit is an
error and leaves the device as it was: nothing is ever cut short.
"""

from protocol.errors import TagError


class Device:
    """A memory of ``capacity_bytes`` with compare-and-set.

    Attributes:
        capacity_bytes: the longest tag that fits (RFID tags: about 144 to 888 bytes).
        tag: the bytes it holds; empty where it is blank.
        revision: how often it was written; 0 where it never was.
    """

    __slots__ = ("capacity_bytes", "revision", "tag")

    capacity_bytes: int
    tag: bytes
    revision: int

    def __init__(self, capacity_bytes: int, tag: bytes = b"", revision: int = 0) -> None:
        """Make a device, blank or with the tag that it holds already.

        Args:
            capacity_bytes: the longest tag that fits.
            tag: what it holds.
            revision: how often it was written before.

        Raises:
            TagError: If ``tag`` does not fit.
            ValueError: If the capacity or the revision is negative.
        """
        if capacity_bytes < 0 or revision < 0:
            raise ValueError(
                f"capacity of {capacity_bytes} bytes, revision {revision}; neither may be negative"
            )
        self.capacity_bytes = capacity_bytes
        self._check(tag)
        self.tag = tag
        self.revision = revision

    def write(self, tag: bytes) -> int:
        """Replace the tag.

        Args:
            tag: the new tag.

        Returns:
            The new revision.

        Raises:
            TagError: If ``tag`` does not fit; the device is unchanged.
        """
        self._check(tag)
        self.tag = tag
        self.revision += 1
        return self.revision

    def compare_and_set(self, expected_revision: int, tag: bytes) -> bool:
        """Replace the tag if nobody has written since ``expected_revision``.

        Args:
            expected_revision: the revision that the writer saw.
            tag: the new tag.

        Returns:
            Whether the tag was replaced.

        Raises:
            TagError: If ``tag`` does not fit, whatever the revision; the device is unchanged.
        """
        self._check(tag)
        if self.revision != expected_revision:
            return False
        self.tag = tag
        self.revision += 1
        return True

    def _check(self, tag: bytes) -> None:
        if len(tag) > self.capacity_bytes:
            raise TagError(
                f"tag of {len(tag)} bytes; the device holds at most {self.capacity_bytes}"
            )
