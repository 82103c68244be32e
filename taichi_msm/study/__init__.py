"""Speed against error: the cost and the error of every setting of a scene."""
