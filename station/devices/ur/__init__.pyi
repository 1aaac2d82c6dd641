from .guided_arm import GuidedArm as GuidedArm
from .robot import UrRobot as UrRobot
from .robot import control_path as control_path
from .robot import control_trouble as control_trouble
from .robot import library_installed as library_installed
from .stream import TraceRecorder as TraceRecorder
