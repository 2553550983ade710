"""Contract tests, as pytest classes: what every joint driver, camera driver and detector must fulfil.

Subclass one in your own tests, override the factory of your driver, and run pytest::

    from stereoservo_drivers.contracts import JointDriverContract

    class TestMyArm(JointDriverContract):
        def make_driver(self, context):
            return MyArm({"port": "/dev/ttyUSB0"}, context)

Needs pytest, which the service itself does not.
"""

from stereoservo_drivers.contracts.suites import CameraDriverContract, DetectorContract, JointDriverContract

__all__ = ["CameraDriverContract", "DetectorContract", "JointDriverContract"]
