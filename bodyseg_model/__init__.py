"""Networks that tell body parts apart in range images, and the scores they are judged by."""
