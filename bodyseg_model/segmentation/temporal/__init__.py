"""Labels of a video: evidence of earlier frames is carried along with the surface that it was found on."""
