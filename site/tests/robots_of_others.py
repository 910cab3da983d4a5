"""Robots as their makers and textbooks publish them, for tests: DH tables, and a URDF with everything awkward in it."""

UR5_CSV = """# Universal Robots, support article "DH parameters for calculations of kinematics and dynamics"
# name: UR5
# convention: standard
# parallel: 2, 3
joint,alpha_deg,a_mm,d_mm,theta_deg,kind,lower_deg,upper_deg
1,90,0,89.159,0,revolute,-360,360
2,0,-425,0,0,revolute,-360,360
3,0,-392.25,0,0,revolute,-180,180
4,90,0,109.15,0,revolute,-360,360
5,-90,0,94.65,0,revolute,-360,360
6,0,0,82.3,0,revolute,-360,360
"""

PUMA_TOML = """# Corke, Robotics, Vision and Control: standard DH of the Puma 560
name = "Puma 560"
convention = "standard"
parallel = [2]

[conventions]
signs = [1, -1, -1, 1, 1, 1]      # an invented pendant
offsets_deg = [0, 90, -90, 0, 0, 0]
coupling = [[3, 2, -1.0]]

[[joint]]
alpha_deg = 90
a_m = 0
d_m = 0
theta_deg = 0

[[joint]]
alpha_deg = 0
a_m = 0.4318  # upper arm
d_m = 0
theta_deg = 0

[[joint]]
alpha_deg = -90
a_m = 0.0203
d_m = 0.15005
theta_deg = 0

[[joint]]
alpha_rad = 1.5707963267948966
a_m = 0
d_m = 0.4318
theta_deg = 0
lower_deg = -110
upper_deg = 170

[[joint]]
alpha_deg = -90
a_m = 0
d_m = 0
theta_deg = 0

[[joint]]
alpha_deg = 0
a_m = 0
d_m = 0
theta_deg = 0
"""

IIWA = {  # KUKA LBR iiwa 14 R820, manual of the media flange; modified DH, mm and degrees
    "alpha": (0, -90, 90, 90, -90, -90, 90),
    "a": (0,) * 7,
    "d": (360, 0, 420, 0, 400, 0, 126),
    "theta": (0,) * 7,
}

KR16_CSV = """# KUKA KR 16, its drawing's lengths; Craig's convention, joint 3 turned so that zero is the pendant's
# convention: modified
# parallel: 2
joint,alpha_deg,a_mm,d_mm,theta_deg,lower_deg,upper_deg
1,0,0,675,0,-185,185
2,-90,260,0,0,-155,35
3,0,680,0,-90,-130,154
4,-90,-35,670,0,-350,350
5,90,0,0,0,-130,130
6,-90,0,115,180,-350,350
"""

UR5_URDF = """<?xml version="1.0" encoding="utf-8"?>
<!-- the numbers of ur_description's ur5, the layout everyone's own -->
<robot name='ur5' xmlns:xacro="http://wiki.ros.org/xacro">
  <link name="base_link"/><link name="inertia"/> <link name="shoulder"/> <link name="upper"/>
  <link name="fore"/> <link name="w1"/> <link name="w2"/> <link name="w3"/> <link name="flange"/> <link name="tool0"/>
  <link name="finger"/>
  <joint name="base_fixed" type="fixed">
    <origin xyz="0 0 0" rpy="0 0 3.141592653589793"/>
    <parent link="base_link"/> <child link="inertia"/>
  </joint>
  <joint name="shoulder_pan" type="revolute">
    <parent link="inertia"/>
    <child link="shoulder"/>
    <origin   rpy='0 0 0'
              xyz='0 0 0.089159' />   <!-- attributes in the other order -->
    <axis xyz="0 0 1"/>
    <limit lower="-6.283185307179586" upper="6.283185307179586" effort="150" velocity="3.14"/>
  </joint>
  <joint name="shoulder_lift" type="revolute">
    <parent link="shoulder"/> <child link="upper"/>
    <origin xyz="0 0 0" rpy="1.570796327 0 0"/>
    <axis xyz="0 0 1"/>
    <limit lower="-6.28" upper="6.28" effort="150" velocity="3.14"/>
  </joint>
  <joint name="elbow" type="revolute">
    <parent link="upper"/> <child link="fore"/>
    <axis xyz="0 0 1"/>
    <origin xyz="-0.425 0 0"/>
    <limit lower="-3.14" upper="3.14" effort="150" velocity="3.14"/>
  </joint>
  <joint name="wrist_1" type="revolute">
    <parent link="fore"/> <child link="w1"/>
    <origin xyz="-0.39225 0 0.10915" rpy="0 0 0"/>
    <axis xyz="0 0 1"/>
    <limit lower="-6.28" upper="6.28" effort="28" velocity="3.14"/>
  </joint>
  <joint name="wrist_2" type="revolute">
    <parent link="w1"/> <child link="w2"/>
    <origin xyz="0 -0.09465 -1.941303950897609e-11" rpy="1.570796327 0 0"/>
    <axis xyz="0 0 1"/>
    <limit lower="-6.28" upper="6.28" effort="28" velocity="3.14"/>
  </joint>
  <joint name="wrist_3" type="revolute">
    <parent link="w2"/> <child link="w3"/>
    <origin xyz="0 0.0823 -1.688001216681175e-11" rpy="1.570796326589793 3.141592653589793 3.141592653589793"/>
    <axis xyz="0 0 1"/>
    <limit lower="-6.28" upper="6.28" effort="28" velocity="3.14"/>
  </joint>
  <joint name="to_flange" type="fixed">
    <parent link="w3"/> <child link="flange"/>
    <origin rpy="0 -1.5707963267948966 -1.5707963267948966"/>
  </joint>
  <joint name="to_tool0" type="fixed">
    <parent link="flange"/> <child link="tool0"/>
    <origin rpy="1.5707963267948966 0 1.5707963267948966" xyz="0 0 0"/>
  </joint>
  <joint name="gripper" type="prismatic">
    <parent link="tool0"/> <child link="finger"/>
    <mimic joint="elbow"/>
  </joint>
  <transmission name="t"><joint name="elbow"><hardwareInterface>effort</hardwareInterface></joint></transmission>
</robot>
"""

ODD_URDF = """<robot name="odd">
 <link name="world"/><link name="a"/><link name="b"/><link name="c"/><link name="d"/><link name="e"/>
 <joint name="rail" type="prismatic"><parent link="world"/><child link="a"/>
   <origin xyz="0.1 -0.2 0.3" rpy="0.1 1.5707963267948966 -0.4"/><axis xyz="1 2 -2"/><limit lower="-0.5" upper="1.5"/>
 </joint>
 <joint name="plate" type="fixed"><parent link="a"/><child link="b"/><origin xyz="0 0.05 0.6" rpy="0 0 1"/></joint>
 <joint name="spin" type="continuous"><parent link="b"/><child link="c"/><axis xyz="0 -1 0"/></joint>
 <joint name="swing" type="revolute"><parent link="c"/><child link="d"/><origin rpy="-2 0.5 3"/>
   <limit lower="-1" upper="2"/></joint>
 <joint name="end" type="fixed"><parent link="d"/><child link="e"/><origin xyz="0.2 0 0.01" rpy="0.3 0.2 0.1"/></joint>
</robot>
"""
