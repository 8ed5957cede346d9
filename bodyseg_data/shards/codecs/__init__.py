"""Codecs of a sample's images. A new one is a file in this folder and an entry of `CODECS`."""

from typing import TYPE_CHECKING, Final, Literal

from bodyseg_data.shards.codecs.bodyseg_images import BodysegImages
from bodyseg_data.shards.codecs.codec import ImageCodec
from bodyseg_data.shards.codecs.png import PngImages

CODECS: Final[dict[str, ImageCodec]] = {"bsi": BodysegImages(), "png": PngImages()}
"""Name -> codec; the first is the default."""

if TYPE_CHECKING:
    CodecName = str
else:
    CodecName = Literal[tuple(CODECS)]
