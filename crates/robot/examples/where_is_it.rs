//! Loads a URDF or xacro and prints where a link is: `where_is_it FILE|builtin:NAME LINK [Q…]`, joints in rad or m.

use dimos_core::pose::to_xyz_rpy;
use dimos_robot::kinematics::{Kinematics, pose};
use dimos_robot::{Source, load};

fn main() -> Result<(), String> {
    let mut words = std::env::args().skip(1);
    let (Some(file), Some(link)) = (words.next(), words.next()) else {
        return Err("give a description and a link".into());
    };
    let loaded = load(&Source::new(file));
    eprint!("{}", loaded.render(false)); // every mistake at its line, through macros and includes
    let model = loaded.model.ok_or("the description has mistakes")?;
    let kinematics = Kinematics::whole(&model).map_err(|error| error.to_string())?;
    let mut q = vec![0.0; kinematics.dof()];
    for (joint, word) in q.iter_mut().zip(words) {
        *joint = word.parse().map_err(|_| format!("{word} is not a number"))?;
    }
    for ((name, limits), q) in kinematics.names().iter().zip(kinematics.limits()).zip(&q) {
        println!("{name:12} {q:8.4}   {:.4} to {:.4}", limits.lower, limits.upper);
    }
    let mut frames = kinematics.frames();
    kinematics.forward(&q, &mut frames);
    let link = model.link_index(&link).ok_or_else(|| format!("there is no link {link}"))?;
    let (xyz, rpy) = to_xyz_rpy(&pose(&kinematics.link_frame(link, &frames)));
    println!("xyz {xyz:.4?} m, rpy {rpy:.4?} rad");
    Ok(())
}
