//! Tables for terminals, Markdown, spreadsheets and papers.

use std::fmt::Write;

/// Titles and rows of equally many cells; the first column names the rows.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Table {
    /// What the table is, in a line.
    pub caption: String,
    /// One per column.
    pub titles: Vec<String>,
    /// Each with one cell per title.
    pub rows: Vec<Vec<String>>,
    /// Lines below.
    pub notes: Vec<String>,
}

impl Table {
    /// Columns aligned with blanks: the first to the left, numbers to the right.
    #[must_use]
    pub fn to_text(&self) -> String {
        let widths: Vec<usize> = (0..self.titles.len()).map(|column| self.width(column)).collect();
        let line = |cells: &[String]| {
            let mut text = String::new();
            for (column, (cell, width)) in cells.iter().zip(&widths).enumerate() {
                let blanks = " ".repeat(width - cell.chars().count());
                text += &if column == 0 {
                    format!("{cell}{blanks}")
                } else {
                    format!("  {blanks}{cell}")
                };
            }
            text.trim_end().to_owned() + "\n"
        };
        let lines = self.rows.iter().map(|row| line(row));
        let notes = self.notes.iter().map(|note| format!("{note}\n"));
        format!("{}\n", self.caption)
            + &line(&self.titles)
            + &lines.chain(notes).collect::<String>()
    }

    fn width(&self, column: usize) -> usize {
        let cells = self.rows.iter().filter_map(|row| row.get(column));
        let all = cells.chain(self.titles.get(column));
        all.map(|cell| cell.chars().count()).max().unwrap_or(0)
    }

    /// A GitHub table.
    #[must_use]
    pub fn to_markdown(&self) -> String {
        let line = |cells: &[String]| {
            let cells: Vec<String> = cells.iter().map(|cell| cell.replace('|', "\\|")).collect();
            format!("| {} |\n", cells.join(" | "))
        };
        let rule = "|---".repeat(self.titles.len()) + "|\n";
        let rows: String = self.rows.iter().map(|row| line(row)).collect();
        let notes: String = self.notes.iter().map(|note| format!("\n{note}\n")).collect();
        format!("{}\n\n", self.caption) + &line(&self.titles) + &rule + &rows + &notes
    }

    /// Comma-separated values (RFC 4180), titles first, without caption and notes.
    #[must_use]
    pub fn to_csv(&self) -> String {
        let quoted = |cell: &String| {
            if cell.contains([',', '"', '\n', '\r']) {
                format!("\"{}\"", cell.replace('"', "\"\""))
            } else {
                cell.clone()
            }
        };
        let lines = std::iter::once(&self.titles).chain(&self.rows);
        lines.map(|row| row.iter().map(quoted).collect::<Vec<_>>().join(",") + "\n").collect()
    }

    /// A LaTeX table in the form of the paper's: the best value of each column whose title ends in an arrow is bold.
    #[must_use]
    pub fn to_latex(&self) -> String {
        let mut text = String::from("\\begin{table}[htbp]\n  \\centering\n");
        // Writing to a string cannot fail.
        let _ = writeln!(text, "  \\caption{{{}}}", latex(&self.caption));
        let _ = writeln!(
            text,
            "  \\begin{{tabular}}{{l|{}}}",
            "c".repeat(self.titles.len().saturating_sub(1))
        );
        let line = |cells: Vec<String>| format!("    {} \\\\", cells.join(" & "));
        let titles = self.titles.iter().map(|title| latex(title)).collect();
        let _ = writeln!(text, "    \\hline\n{} \\hline", line(titles));
        let best: Vec<Option<f64>> =
            (0..self.titles.len()).map(|column| self.best(column)).collect();
        for row in &self.rows {
            let cells =
                row.iter().zip(&best).map(|(cell, best)| match (cell.parse::<f64>(), best) {
                    (Ok(value), Some(best)) if value == *best => {
                        format!("\\textbf{{{}}}", latex(cell))
                    }
                    _ => latex(cell),
                });
            let _ = writeln!(text, "{}", line(cells.collect()));
        }
        text += "    \\hline\n  \\end{tabular}\n";
        for note in &self.notes {
            let _ = writeln!(text, "  \\\\ {{\\footnotesize {}}}", latex(note));
        }
        text + "\\end{table}\n"
    }

    /// The best number of a column, if its title says which direction is better.
    fn best(&self, column: usize) -> Option<f64> {
        let numbers = self.rows.iter().filter_map(|row| row.get(column)?.parse::<f64>().ok());
        match self.titles.get(column)?.chars().last()? {
            '↑' => numbers.max_by(f64::total_cmp),
            '↓' => numbers.min_by(f64::total_cmp),
            _ => None,
        }
    }
}

/// Text with LaTeX's special characters made harmless.
fn latex(text: &str) -> String {
    let mut safe = String::new();
    for character in text.chars() {
        match character {
            '&' | '%' | '$' | '#' | '_' | '{' | '}' => safe.extend(['\\', character]),
            '\\' => safe += "\\textbackslash{}",
            '~' => safe += "\\textasciitilde{}",
            '^' => safe += "\\textasciicircum{}",
            '↑' => safe += "$\\uparrow$",
            '↓' => safe += "$\\downarrow$",
            '°' => safe += "$^\\circ$",
            other => safe.push(other),
        }
    }
    safe
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table() -> Table {
        let row = |cells: [&str; 3]| cells.map(str::to_owned).to_vec();
        Table {
            caption: "Two methods".to_owned(),
            titles: row(["method", "RR % ↑", "TE cm ↓"]),
            rows: vec![row(["a_b, \"c\"", "90.0", "7.10"]), row(["d|e", "9.5", "-"])],
            notes: vec!["a note".to_owned()],
        }
    }

    #[test]
    fn every_form_holds_every_cell() {
        let table = table();
        assert_eq!(
            table.to_text(),
            "Two methods\nmethod    RR % ↑  TE cm ↓\na_b, \"c\"    90.0     7.10\nd|e          9.5        -\na note\n"
        );
        assert_eq!(
            table.to_markdown(),
            "Two methods\n\n| method | RR % ↑ | TE cm ↓ |\n|---|---|---|\n| a_b, \"c\" | 90.0 | 7.10 |\n| d\\|e | 9.5 | - |\n\na note\n"
        );
        assert_eq!(
            table.to_csv(),
            "method,RR % ↑,TE cm ↓\n\"a_b, \"\"c\"\"\",90.0,7.10\nd|e,9.5,-\n"
        );
        let latex = table.to_latex();
        assert!(latex.contains("a\\_b, \"c\" & \\textbf{90.0} & \\textbf{7.10} \\\\"), "{latex}");
        assert!(
            latex.contains("method & RR \\% $\\uparrow$ & TE cm $\\downarrow$ \\\\ \\hline"),
            "{latex}"
        );
        assert!(latex.contains("d|e & 9.5 & - \\\\"), "{latex}");
    }
}
