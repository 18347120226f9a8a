"""Arms of capsules and boxes, whose parts are known by construction."""

FINGERS = """
<body name="left_finger" pos="0.008 0 0.13">
  <joint name="left" type="slide" axis="1 0 0" range="0 0.04"/>
  <geom type="box" size="0.008 0.01 0.03" mass="0.05"/></body>
<body name="right_finger" pos="-0.008 0 0.13">
  <joint name="right" type="slide" axis="-1 0 0" range="0 0.04"/>
  <geom type="box" size="0.008 0.01 0.03" mass="0.05"/></body>
"""
SERVOS = """
<position joint="left" kp="500" forcerange="-30 30"/><position joint="right" kp="500" forcerange="-30 30"/>
"""
MOTORS = "".join(f'<motor joint="j{n}" ctrlrange="-1 1" gear="{120 if n < 4 else 40}"/>' for n in range(1, 7))


def arm(fingers=FINGERS, actuators=MOTORS + SERVOS, length=0.4, more="", compiler='angle="radian"'):
    """Returns the MJCF of an arm of six joints, whose two long links have a length, metres."""
    limits = 'range="-3 3"' if "radian" in compiler else 'range="-171.887 171.887"'
    link = f'<geom type="capsule" fromto="0 0 0 0 0 {length}" size="0.04" mass="2"/>'
    return f"""
<mujoco model="arm"><compiler {compiler} autolimits="true"/><default><joint {limits}/></default>
  <worldbody>{more}<body name="base"><geom size="0.06" mass="3"/><body name="turret" pos="0 0 0.2">
    <joint name="j1" axis="0 0 1"/><geom size="0.05" mass="2"/>
    <body name="upper"><joint name="j2" axis="0 1 0"/>{link}<body name="fore" pos="0 0 {length}">
      <joint name="j3" axis="0 1 0"/>{link}<body name="wrist" pos="0 0 {length}">
        <joint name="j4" axis="0 1 0"/><geom size="0.04" mass="0.5"/><body pos="0 0 0.06">
          <joint name="j5" axis="1 0 0"/><geom size="0.03" mass="0.4"/><body name="palm" pos="0 0 0.04">
            <joint name="j6" axis="0 0 1"/><geom type="box" size="0.06 0.02 0.04" pos="0 0 0.04" mass="0.5"/>
            <site name="flange" pos="0 0 0.08"/>{fingers}</body></body></body></body></body></body></body></worldbody>
  <actuator>{actuators}</actuator></mujoco>"""
