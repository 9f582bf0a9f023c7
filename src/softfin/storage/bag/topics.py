"""Names of the topics that softfin records and looks for; apart, since a robot writes bags and reads none."""

DEFAULT_TOPICS = {"command": "/fin/command", "joint": "/fin/joint_states", "wrench": "/fin/wrench"}
