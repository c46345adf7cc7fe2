//! Identity: table row, info, limits, address, options, number of joints.

use super::Check;
use super::Needs::Nothing;
use super::context::{Context, require};
use crate::registry::AdapterConfig;

/// The checks of this file.
pub const CHECKS: &[Check] = &[
    Check::new(Nothing, "row_is_complete", "the table row is filled in and consistent", row_is_complete),
    Check::new(Nothing, "describes_itself", "get_info and get_dof agree with the row", describes_itself),
    Check::new(Nothing, "limits_are_usable", "limits are finite, ordered, one per joint", limits_are_usable),
    Check::new(Nothing, "addresses_are_checked", "ill-formed addresses are refused", addresses_are_checked),
    Check::new(Nothing, "options_are_strict", "unknown options are refused by name", options_are_strict),
    Check::new(Nothing, "dof_is_checked", "a number of joints it cannot have is refused", dof_is_checked),
];

fn row_is_complete(context: &mut Context) -> Result<(), String> {
    let row = &context.row;
    let name_ok =
        !row.name.is_empty() && row.name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_');
    require(name_ok, || format!("name {:?} is not lower-case letters, digits and _", row.name))?;
    require(!row.about.is_empty() && !row.transport.is_empty() && !row.wire_units.is_empty(), || {
        "about, transport or wire_units is empty".into()
    })?;
    require(1 <= row.dof.0 && row.dof.0 <= row.dof.1, || format!("dof {:?} is not a range", row.dof))?;
    require(!row.modes.is_empty(), || "it has no modes".into())?;
    require(row.native_rate > 0.0, || format!("native_rate is {}", row.native_rate))
}

fn describes_itself(context: &mut Context) -> Result<(), String> {
    context.connect()?;
    let (info, row, dof) = (context.adapter.get_info(), &context.row, context.config.dof);
    require(!info.vendor.is_empty() && !info.model.is_empty(), || "vendor or model is empty".into())?;
    require(info.dof == dof && context.adapter.get_dof() == dof, || format!("it says {} joints, not {dof}", info.dof))?;
    // An arm that says itself how many joints it has may say how it is commanded, too.
    let own = row.dof.0 < row.dof.1 && !info.modes.is_empty() && info.modes.iter().all(|mode| row.modes.contains(mode));
    require(own || info.modes == row.modes, || format!("modes {:?}, in the table {:?}", info.modes, row.modes))?;
    require(info.native_rate > 0.0, || format!("native_rate is {}", info.native_rate))?;
    require(info.holds_when_disabled == row.holds_when_disabled, || "holds_when_disabled is not the table's".into())
}

fn limits_are_usable(context: &mut Context) -> Result<(), String> {
    context.connect()?;
    let dof = context.config.dof;
    let checked =
        (context.row.check)(&context.config).map_err(|error| format!("its own configuration is refused: {error}"))?;
    for (source, limits) in [("check", checked.limits), ("get_limits", context.limits()?)] {
        let required = [&limits.position_lower, &limits.position_upper, &limits.velocity_max];
        require(required.iter().all(|values| values.len() == dof), || format!("{source}: not {dof} values"))?;
        for optional in [&limits.acceleration_max, &limits.jerk_max] {
            require(optional.is_empty() || optional.len() == dof, || format!("{source}: neither 0 nor {dof} values"))?;
            require(optional.iter().all(|v| v.is_finite() && *v > 0.0), || {
                format!("{source}: a limit is not above 0")
            })?;
        }
        let finite = required.iter().all(|values| values.iter().all(|v| v.is_finite()));
        require(finite, || format!("{source}: a limit is not finite"))?;
        let ordered = limits.position_lower.iter().zip(&limits.position_upper).all(|(lower, upper)| lower < upper);
        require(ordered, || format!("{source}: a lower limit is not below its upper limit"))?;
        // Limits of 100 rad or 100 rad/s are in degrees.
        let radians = limits.position_lower.iter().chain(&limits.position_upper).chain(&limits.velocity_max);
        require(radians.into_iter().all(|v| v.abs() < 100.0), || format!("{source}: these limits are not in rad"))?;
        require(limits.velocity_max.iter().all(|v| *v > 0.0), || format!("{source}: a velocity limit is not above 0"))?;
    }
    Ok(())
}

fn addresses_are_checked(context: &mut Context) -> Result<(), String> {
    let address = context.row.address;
    require(!address.form.is_empty(), || "the form of the address is not stated".into())?;
    if !address.required {
        return context.skip("this adapter needs no address");
    }
    require((address.check)("").is_err(), || "an empty address is accepted".into())?;
    let own = (address.check)(&context.config.address);
    own.map(drop).map_err(|e| format!("the emulator's own address is refused: {e}"))
}

fn options_are_strict(context: &mut Context) -> Result<(), String> {
    let options = serde_json::json!({ "no_such_option": 1 });
    let config = AdapterConfig { options, ..context.config.clone() };
    let checked = (context.row.check)(&config).map(drop).map_err(|error| error.to_string());
    let made = (context.row.create)(&config).map(drop).map_err(|error| error.to_string());
    for (by, result) in [("check", checked), ("create", made)] {
        let error = result.err().ok_or_else(|| format!("{by} accepts an unknown option"))?;
        require(error.contains("no_such_option"), || format!("{by}: the error does not name the option: {error}"))?;
    }
    Ok(())
}

fn dof_is_checked(context: &mut Context) -> Result<(), String> {
    let (fewest, most) = context.row.dof;
    for dof in [fewest.wrapping_sub(1), most + 1] {
        let config = AdapterConfig { dof, ..context.config.clone() };
        require((context.row.check)(&config).is_err(), || format!("check accepts {dof} joints"))?;
        require((context.row.create)(&config).is_err(), || format!("create accepts {dof} joints"))?;
    }
    Ok(())
}
