//! Simulated scans of made-up scenes with known poses, for the demo, tests and benches.
//!
//! A scene ([`Room`], [`Street`], [`object`]) is a list of boxes, cylinders and balls that a seed arranges; a sensor
//! ([`DepthSensor`], [`Lidar`]) casts its rays into it and adds the faults of its kind; a [`ScanPair`] is two such
//! scans with the true pose between them and a wrong start.

mod depth_sensor;
mod lidar;
mod object;
mod overlap;
mod pair;
mod room;
mod scene;
mod street;
mod views;

pub use depth_sensor::DepthSensor;
pub use lidar::Lidar;
pub use object::object;
pub use pair::{ScanPair, demo_pair, object_pair, perturb, room_pair, street_pair};
pub use room::Room;
pub use scene::{Hit, RayCaster, Scene, Shape, Solid};
pub use street::Street;
