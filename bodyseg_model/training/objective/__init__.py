"""What a training minimises: the loss over selected pixels of bodies, by labels and by a teacher."""
