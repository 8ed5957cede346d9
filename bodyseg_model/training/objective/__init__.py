"""The loss of a training over selected pixels of bodies, by labels and by a teacher."""
