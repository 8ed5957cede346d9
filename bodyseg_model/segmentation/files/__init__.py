"""Files of a recording: decoding of frames, their names in results, cameras beside them, and the folder of results."""
