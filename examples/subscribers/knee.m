% Print the knee flexion once per second. The script needs the Industrial Communication Toolbox (R2022a or newer).
% The tests of jointfitd do not run this file, because MATLAB is not free.
broker = "tcp://127.0.0.1";
base = "jointfit/bench-1";                % [mqtt] base of rig.toml

client = mqttclient(broker, Port = 1883);
subscribe(client, base + "/joint/knee", Callback = @showFlexion);
disp("Press a key to stop");
pause;
clear client

function showFlexion(~, payload)
    knee = jsondecode(payload);           % null becomes []
    if isempty(knee.flexion_deg)
        disp("knee flexion unknown");
    else
        fprintf("knee flexion %.2f° ± %.2f°\n", knee.flexion_deg, knee.sd_deg);
    end
end
