// Filter and order of the table: the worst link first, unless a column is selected.

import { $ } from "./dom.js";
import { known } from "./format.js";
import { byId, worstFirst } from "./health.js";

const FEW = 6; // number of UAVs up to which no search is needed

export class Order {
  constructor(head, columns, onChange) {
    Object.assign(this, { head, columns, key: null, falls: false });
    head.addEventListener("click", (event) => {
      const key = event.target.closest("button")?.closest("th")?.dataset.key;
      if (!key) return;
      // Ascending, descending, then back to the worst first.
      if (this.key !== key) [this.key, this.falls] = [key, false];
      else if (!this.falls) this.falls = true;
      else this.key = null;
      this.mark();
      onChange();
    });
    for (const id of ["search", "only-bad"]) $(id).addEventListener("input", onChange);
  }

  mark() {
    for (const cell of this.head.querySelectorAll("th")) {
      const chosen = cell.dataset.key === this.key;
      cell.setAttribute("aria-sort", !chosen ? "none" : this.falls ? "descending" : "ascending");
    }
  }

  /** The UAVs to show; `beams` by UAV. Unknown values come last in either order. */
  arrange(uavs, beams) {
    $("find").hidden = uavs.length <= FEW;
    const wanted = $("search").value.trim().toLowerCase();
    const shown = uavs.filter((uav) => this.isWanted(uav, wanted)).sort(worstFirst);
    const by = this.columns.find(({ key }) => key === this.key)?.by;
    if (this.key === null || !by) return this.key === "id" ? this.turned(shown.sort(byId)) : shown;
    const values = new Map(shown.map((uav) => [uav, by({ uav, beam: beams.get(uav.id) })]));
    const [there, missing] = [shown.filter((uav) => known(values.get(uav))),
      shown.filter((uav) => !known(values.get(uav)))];
    return [...this.turned(there.sort((a, b) => values.get(a) - values.get(b))), ...missing];
  }

  turned(uavs) {
    return this.falls ? uavs.reverse() : uavs;
  }

  isWanted(uav, text) {
    if ($("find").hidden) return true;
    if ($("only-bad").checked && uav.verdict === "good") return false;
    return `${uav.id} ${uav.callsign ?? ""} ${uav.state} ${uav.verdict ?? ""} `
      .concat(uav.health?.reason ?? "").toLowerCase().includes(text);
  }
}
