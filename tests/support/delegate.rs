//! Methods of an adapter that wraps another one and passes calls on unchanged.

/// `delegate!(inner: connect, get_info);` in an `impl ManipulatorAdapter`: these methods are those of `self.inner`. The
/// names of `dimos::hardware::adapter` must be in scope.
macro_rules! delegate {
    ($inner:ident: $($method:ident),+ $(,)?) => {
        $(delegate!(@ $method $inner);)+
    };
    (@ connect $i:ident) => { delegate!(@@ $i connect(&mut self) -> AdapterResult<()>); };
    (@ disconnect $i:ident) => { delegate!(@@ $i disconnect(&mut self) -> ()); };
    (@ is_connected $i:ident) => { delegate!(@@ $i is_connected(&self) -> bool); };
    (@ activate $i:ident) => { delegate!(@@ $i activate(&mut self) -> AdapterResult<()>); };
    (@ deactivate $i:ident) => { delegate!(@@ $i deactivate(&mut self, rest: &dimos::arm::StopPoint) -> AdapterResult<()>); };
    (@ get_info $i:ident) => { delegate!(@@ $i get_info(&self) -> ManipulatorInfo); };
    (@ get_dof $i:ident) => { delegate!(@@ $i get_dof(&self) -> usize); };
    (@ get_limits $i:ident) => { delegate!(@@ $i get_limits(&mut self) -> AdapterResult<dimos::joint::JointLimits>); };
    (@ get_control_mode $i:ident) => { delegate!(@@ $i get_control_mode(&self) -> dimos::joint::ControlMode); };
    (@ state_fd $i:ident) => { delegate!(@@ $i state_fd(&self) -> Option<std::os::fd::BorrowedFd<'_>>); };
    (@ read_state $i:ident) => { delegate!(@@ $i read_state(&mut self) -> AdapterResult<RobotState>); };
    (@ read_error $i:ident) => { delegate!(@@ $i read_error(&mut self) -> AdapterResult<(i32, String)>); };
    (@ read_enabled $i:ident) => { delegate!(@@ $i read_enabled(&mut self) -> AdapterResult<bool>); };
    (@ write_stop $i:ident) => { delegate!(@@ $i write_stop(&mut self, rest: &dimos::arm::StopPoint) -> AdapterResult<Stop>); };
    (@ write_clear_errors $i:ident) => { delegate!(@@ $i write_clear_errors(&mut self) -> AdapterResult<()>); };
    (@ gripper $i:ident) => { delegate!(@@ $i gripper(&mut self) -> Option<&mut dyn Gripper>); };
    (@ force_torque $i:ident) => { delegate!(@@ $i force_torque(&mut self) -> Option<&mut dyn ForceTorque>); };
    (@ cartesian $i:ident) => { delegate!(@@ $i cartesian(&mut self) -> Option<&mut dyn Cartesian>); };
    (@ set_control_mode $i:ident) => {
        delegate!(@@ $i set_control_mode(&mut self, mode: dimos::joint::ControlMode) -> AdapterResult<()>);
    };
    (@ read_joint_positions $i:ident) => {
        delegate!(@@ $i read_joint_positions(&mut self, positions: &mut [f64]) -> AdapterResult<()>);
    };
    (@ read_joint_velocities $i:ident) => {
        delegate!(@@ $i read_joint_velocities(&mut self, velocities: &mut [f64]) -> AdapterResult<bool>);
    };
    (@ write_joint_positions $i:ident) => {
        delegate!(@@ $i write_joint_positions(&mut self, positions: &[f64], velocity: f64) -> AdapterResult<()>);
    };
    (@ write_joint_velocities $i:ident) => {
        delegate!(@@ $i write_joint_velocities(&mut self, velocities: &[f64]) -> AdapterResult<()>);
    };
    (@ write_setpoint $i:ident) => {
        delegate!(@@ $i write_setpoint(&mut self, setpoint: &dimos::arm::Setpoint) -> AdapterResult<()>);
    };
    (@ write_enable $i:ident) => { delegate!(@@ $i write_enable(&mut self, enable: bool) -> AdapterResult<()>); };
    (@@ $i:ident $method:ident(&mut self $(, $value:ident: $kind:ty)*) -> $result:ty) => {
        fn $method(&mut self $(, $value: $kind)*) -> $result {
            self.$i.$method($($value),*)
        }
    };
    (@@ $i:ident $method:ident(&self) -> $result:ty) => {
        fn $method(&self) -> $result {
            self.$i.$method()
        }
    };
}

pub(crate) use delegate;
