"""Other people's data as recordings: folders of images and poses, ROS 2 bags, any MCAP with both."""
