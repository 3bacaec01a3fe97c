//! Templates and what is put into them.

use std::collections::BTreeMap;

use anyhow::Result;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::Serialize;

use super::data::Report;
use super::index::Index;

const STYLE: &str = include_str!("../../assets/report.css");
/// A module by the name by which others import it.
type Module = (&'static str, &'static str);
/// The published library that draws in three dimensions.
const THREE: [Module; 3] = [
    ("three", include_str!("../../assets/three/three.module.min.js")),
    ("three/core", include_str!("../../assets/three/three.core.min.js")),
    ("three/OrbitControls", include_str!("../../assets/three/OrbitControls.js")),
];
/// What pages of one registration and of many have in common.
const SHARED: [Module; 4] = [
    ("report/charts", include_str!("../../assets/report/charts.js")),
    ("report/colours", include_str!("../../assets/report/colours.js")),
    ("report/page", include_str!("../../assets/report/page.js")),
    ("report/tables", include_str!("../../assets/report/tables.js")),
];
/// What the page of one registration has in addition.
const OF_REGISTRATION: [Module; 7] = [
    ("report/cameras", include_str!("../../assets/report/cameras.js")),
    ("report/data", include_str!("../../assets/report/data.js")),
    ("report/poses", include_str!("../../assets/report/poses.js")),
    ("report/shaders", include_str!("../../assets/report/shaders.js")),
    ("report/view-images", include_str!("../../assets/report/view-images.js")),
    ("report/viewer", include_str!("../../assets/report/viewer.js")),
    ("report/viewer-panel", include_str!("../../assets/report/viewer-panel.js")),
];
/// How one published module imports the other: a relative name, which means nothing in a page without files.
const RELATIVE_CORE: &str = "./three.core.min.js";

/// The page of one registration.
///
/// # Errors
/// If a number cannot be written as JSON.
pub(super) fn of_registration(report: &Report) -> Result<String> {
    let blobs: String = report.blobs.iter().map(|(id, bytes)| blob(id, bytes)).collect();
    Ok(filled(
        include_str!("../../assets/report.html"),
        &[
            ("title", &escaped(&report.page.title)),
            ("css", STYLE),
            ("importmap", &import_map(&[&THREE, &SHARED, &OF_REGISTRATION])?),
            ("script", include_str!("../../assets/report.js")),
            ("data", &json(&report.page)?),
            ("blobs", &blobs),
        ],
    ))
}

/// The page of an evaluation.
///
/// # Errors
/// If a number cannot be written as JSON.
pub(super) fn of_evaluation(index: &Index) -> Result<String> {
    Ok(filled(
        include_str!("../../assets/index.html"),
        &[
            ("title", &escaped(&index.title)),
            ("css", STYLE),
            ("importmap", &import_map(&[&SHARED])?),
            ("script", include_str!("../../assets/index.js")),
            ("data", &json(index)?),
        ],
    ))
}

/// Puts values in the place of `{{name}}`. Each is put in as it is: what looks like a placeholder in it stays.
fn filled(template: &str, values: &[(&str, &str)]) -> String {
    let mut page = String::with_capacity(
        template.len() + values.iter().map(|(_, value)| value.len()).sum::<usize>(),
    );
    let mut rest = template;
    while let Some((before, after)) = rest.split_once("{{") {
        let found = after.split_once("}}").and_then(|(name, after)| {
            let value = values.iter().find(|(known, _)| *known == name)?.1;
            Some((value, after))
        });
        page.push_str(before);
        rest = match found {
            Some((value, after)) => {
                page.push_str(value);
                after
            }
            None => {
                page.push_str("{{");
                after
            }
        };
    }
    page + rest
}

/// Text as HTML shows it.
fn escaped(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\'' => escaped.push_str("&#39;"),
            other => escaped.push(other),
        }
    }
    escaped
}

/// JSON in which nothing can end the script that holds it.
fn json(value: &impl Serialize) -> Result<String> {
    let text = serde_json::to_string(value)?;
    Ok(text.replace('&', "\\u0026").replace('<', "\\u003c").replace('>', "\\u003e"))
}

/// Where the modules lie: in the page itself.
fn import_map(modules: &[&[Module]]) -> Result<String> {
    let place = |(name, text): &Module| {
        let text = text.replace(RELATIVE_CORE, "three/core");
        (*name, format!("data:text/javascript;base64,{}", STANDARD.encode(text)))
    };
    let imports: BTreeMap<&str, String> = modules.iter().copied().flatten().map(place).collect();
    Ok(serde_json::to_string(&BTreeMap::from([("imports", imports)]))?)
}

fn blob(id: &str, bytes: &[u8]) -> String {
    format!("<script type=\"text/plain\" id=\"{id}\">{}</script>\n", STANDARD.encode(bytes))
}

/// An image as an address that holds it.
pub(super) fn image_address(png: &[u8]) -> String {
    format!("data:image/png;base64,{}", STANDARD.encode(png))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_put_in_once() {
        let template = "<a>{{title}}</a>{{data}} {{unknown}} {{ {{title}}";
        let page = filled(template, &[("title", "{{data}}"), ("data", "1")]);
        assert_eq!(page, "<a>{{data}}</a>1 {{unknown}} {{ {{data}}");
    }

    #[test]
    fn hostile_names_stay_text() {
        let name = "</script><script>alert('1')</script>&\"";
        assert!(!escaped(name).contains(['<', '>', '"', '\'']));
        let text = json(&name).unwrap();
        assert!(!text.contains(['<', '>', '&']));
        assert_eq!(serde_json::from_str::<String>(&text).unwrap(), name);
    }

    #[test]
    fn no_module_is_sought_in_a_file() {
        let map: BTreeMap<String, BTreeMap<String, String>> =
            serde_json::from_str(&import_map(&[&THREE, &SHARED, &OF_REGISTRATION]).unwrap())
                .unwrap();
        for (name, address) in &map["imports"] {
            let text = address.strip_prefix("data:text/javascript;base64,").unwrap();
            let text = String::from_utf8(STANDARD.decode(text).unwrap()).unwrap();
            assert!(text.len() > 500, "{name}");
            for relative in ["from\"./", "from \"./", "from \"../"] {
                assert!(!text.contains(relative), "{name}");
            }
        }
        // The replacement did something.
        assert!(THREE[0].1.contains(RELATIVE_CORE));
    }
}
